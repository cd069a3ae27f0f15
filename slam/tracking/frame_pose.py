# SPDX-License-Identifier: Apache-2.0
"""Where a view was taken: landmarks are looked for in it, and the pose follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.config import VerificationConfig
from slam.geometry.feature_grid import FeatureGrid
from slam.geometry.pnp import pose_by_ransac
from slam.geometry.refinement import refine_pose
from slam.geometry.relative_pose import estimate_relative_pose
from slam.geometry.reprojection import Observations
from slam.mapping.landmark_map import LandmarkMap
from slam.types import (
    Camera,
    Features,
    FloatArray,
    Frame,
    IntArray,
    Keyframe,
    Rejection,
    RejectionReason,
)

_CELLS = 8.0  # across the image, when it is asked how much of it features cover
_RADIUS_PX = 4.0  # how far from its place a landmark is looked for once the pose is known


@dataclass(frozen=True)
class View:
    """A frame and the features in it."""

    frame: Frame
    features: Features
    camera: Camera

    @cached_property
    def grid(self) -> FeatureGrid:
        """The features, ready to be searched."""
        return FeatureGrid(self.features, self.camera)

    @cached_property
    def measured(self) -> Observations:
        """What was measured of all of the features."""
        return Observations.of(self.features, np.arange(len(self.features.pixels)), self.camera)

    def covered(self, features: IntArray) -> float:
        """Return in which share of the image some features are, (N,) of all: 1 where all are.

        The image counts by cells, an eighth of it wide, in which there are any.
        """
        cells = np.floor(self.features.undistorted_px * (_CELLS / self.camera.width))
        numbers = (cells[:, 0] + 1e3 * cells[:, 1]).astype(np.int64)
        return len(set(numbers[features].tolist())) / max(1, len(set(numbers.tolist())))

    @property
    def with_depth(self) -> int:
        """How many features have depth."""
        return int(np.count_nonzero(np.isfinite(self.features.depth_m)))


@dataclass(frozen=True)
class FramePose:
    """Where a view was taken, and why that is believed.

    Attributes:
        T_map_cam: (4, 4).
        pairs: (M, 2) int, landmark id and feature, those that agree.
        hessian: (6, 6) of the pose, for a tangent on its right.
    """

    T_map_cam: FloatArray
    pairs: IntArray
    hessian: FloatArray


def agreed_pose(
    the_map: LandmarkMap, view: View, pairs: IntArray, config: VerificationConfig
) -> FloatArray | Rejection:
    """Return the T_map_cam that most of (M, 2) pairs (landmark id, feature) agree on.

    In a fast turn a third of the pairs near a predicted pose are wrong, all in the same direction:
    a least-squares fit that begins there would follow them.
    """
    if len(pairs) < config.min_matches:
        return Rejection(RejectionReason.FEW_MATCHES, len(pairs), config.min_matches)
    points_m = the_map.landmarks.positions_m[pairs[:, 0]]
    pixels = view.features.undistorted_px[pairs[:, 1]]
    found = pose_by_ransac(
        points_m, pixels, the_map.camera, config.max_reprojection_px, config.ransac_iterations
    )
    if found is None:
        return Rejection(RejectionReason.NO_POSE, 0, config.min_inliers)
    T_map_cam, inlier_mask = found
    inliers = int(np.count_nonzero(inlier_mask))
    if inliers < config.min_inliers:
        return Rejection(RejectionReason.FEW_INLIERS, inliers, config.min_inliers)
    measured = view.measured.select(pairs[:, 1])
    return refine_pose(T_map_cam, points_m, measured, the_map.camera, inlier_mask).T_world_cam


def track_local_map(
    the_map: LandmarkMap,
    view: View,
    T_map_cam: FloatArray,
    ids: IntArray,
    config: VerificationConfig,
) -> FramePose | Rejection:
    """Look for (P,) landmarks close to where they should be, and let all refine the (4, 4) pose."""
    pairs = the_map.search(view.grid, T_map_cam, ids, _RADIUS_PX)
    return refined_pose(the_map, view, T_map_cam, pairs, config)


def refined_pose(
    the_map: LandmarkMap,
    view: View,
    T_map_cam: FloatArray,
    pairs: IntArray,
    config: VerificationConfig,
) -> FramePose | Rejection:
    """Return the pose near a (4, 4) guess that (M, 2) pairs (landmark id, feature) agree on."""
    measured = view.measured.select(pairs[:, 1])
    points_m = the_map.landmarks.positions_m[pairs[:, 0]]
    refined = refine_pose(T_map_cam, points_m, measured, the_map.camera)
    inliers = int(np.count_nonzero(refined.inlier_mask))
    if inliers < config.min_inliers:
        return Rejection(RejectionReason.FEW_INLIERS, inliers, config.min_inliers)
    return FramePose(refined.T_world_cam, pairs[refined.inlier_mask], refined.hessian)


def pose_by_keyframes(
    the_map: LandmarkMap, view: View, keyframes: Sequence[Keyframe], config: VerificationConfig
) -> FramePose | Rejection:
    """Compare the view with all features of keyframes, wherever it may be, until one fits."""
    rejections = []
    for keyframe in keyframes:
        outcome = estimate_relative_pose(
            keyframe.features, view.features, view.camera, config, keyframe.camera
        ).outcome
        if isinstance(outcome, Rejection):
            rejections.append(outcome)
            continue
        T_map_cam = the_map.keyframes[keyframe.id].T_map_cam @ outcome.T_ref_query
        seen_ids = the_map.seen_by([keyframe.id])
        frame_pose = track_local_map(the_map, view, T_map_cam, seen_ids, config)
        if isinstance(frame_pose, FramePose):
            return frame_pose
        rejections.append(frame_pose)
    return rejections[0]

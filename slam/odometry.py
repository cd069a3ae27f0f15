# SPDX-License-Identifier: Apache-2.0
"""RGB-D odometry: every frame is placed among the landmarks of a local map."""

from dataclasses import dataclass

import numpy as np

from slam import se3
from slam.config import Config
from slam.features import FeatureExtractor
from slam.guided_search import FeatureGrid
from slam.landmark_map import LandmarkMap, empty_pairs
from slam.landmarks import UNSEEN, IntArray
from slam.local_map import LocalMap
from slam.placement import Placement, View, agreed_pose, look_around
from slam.preview import preview
from slam.relative_pose import (
    allow_for_turning,
    estimate_relative_pose,
    measure_relative_pose,
    with_floor,
)
from slam.types import (
    Camera,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    Rejection,
    RejectionReason,
    RelativePose,
)

# How far from its place a landmark is looked for, in pixels of the finest level.
_PREDICTED_RADII_PX = (15.0, 40.0)  # where the last motion should have gone on; then wider


@dataclass(frozen=True)
class TrackedFrame:
    """A frame that was placed.

    Attributes:
        keyframe_id: the keyframe it was placed against.
        T_kf_cam: (4, 4) pose in that keyframe's camera frame.
        new_keyframe: the frame as a keyframe, where it became one.
        links: the new keyframe's motions to earlier ones, the one it was placed against first.
    """

    keyframe_id: int
    T_kf_cam: FloatArray
    new_keyframe: Keyframe | None = None
    links: tuple[Link, ...] = ()


class RgbdOdometry:
    """Tracks a camera frame by frame and decides which frames become keyframes."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self._camera = camera
        self._config = config.odometry
        self._link_config = config.verification
        # A frame that follows its keyframe needs less evidence than a jump across the map.
        self._tracking_config = config.verification.model_copy(
            update={
                "min_matches": config.odometry.min_inliers,
                "min_inliers": config.odometry.min_inliers,
                "min_inlier_ratio": 0.0,
                "min_support": 0.0,
            }
        )
        self._extractor = FeatureExtractor(camera, config.features)
        self._local_map = LocalMap(camera, config)
        self._recent: list[Keyframe] = []
        self._most_shared = 0  # landmarks that a frame had in common with the last keyframe
        self._last_s = 0.0
        self._T_odom_last = np.eye(4)
        self._T_last_next = np.eye(4)  # the last motion, which should go on
        self._last_ids: IntArray = np.zeros(0, dtype=np.int64)

    @property
    def map(self) -> LandmarkMap:
        """All keyframes and landmarks so far, in the odometry's frame."""
        return self._local_map.whole

    def track(self, frame: Frame) -> TrackedFrame | Rejection:
        """Place a frame, or say why it cannot be placed; later frames are tried all the same."""
        features = self._extractor.extract(frame)
        view = View(frame, features, FeatureGrid(features, self._camera))
        self.settle()
        if not self._recent:
            return self._start(view)
        placement = self._follow(view)
        if isinstance(placement, Rejection):
            placement = self._recover(view)
        if isinstance(placement, Rejection):
            return placement
        return self._go_on(view, placement)

    def settle(self) -> None:
        """Adjust the map to the last keyframe, and go on from where that puts it."""
        if self._local_map.settle():
            last_id = self._recent[-1].id
            self._T_odom_last = self.map.keyframes[last_id].T_map_cam
            self._last_ids = self.map.seen_by([last_id])

    def _start(self, view: View) -> TrackedFrame | Rejection:
        has_depth = np.isfinite(view.features.depth_m)
        with_depth, needed = int(np.count_nonzero(has_depth)), self._tracking_config.min_matches
        if with_depth < needed:
            return Rejection(RejectionReason.FEW_MATCHES, with_depth, needed)
        here = Placement(np.eye(4), empty_pairs(), np.zeros((6, 6)))
        return TrackedFrame(0, np.eye(4), self._insert(view, here, turning_rad_s=0.0))

    def _follow(self, view: View) -> Placement | Rejection:
        """Look for what the last frame saw where it should be by now, then for all around it."""
        T_predicted = self._T_odom_last @ self._T_last_next
        last_ids = self.map.landmarks.resolve(self._last_ids)
        last_ids = np.unique(last_ids[last_ids != UNSEEN])
        for radius_px in _PREDICTED_RADII_PX:
            pairs = self.map.search(view.grid, T_predicted, last_ids, radius_px)
            agreed = agreed_pose(self.map, view, pairs, self._tracking_config)
            if not isinstance(agreed, Rejection):
                nearby_ids = self._local_map.nearby_ids
                return look_around(self.map, view, agreed, nearby_ids, self._tracking_config)
            rejection = agreed
        return rejection

    def _recover(self, view: View) -> Placement | Rejection:
        """Compare the view with all features of the last keyframes, wherever it may be."""
        rejections = []
        for keyframe in reversed(self._recent):
            outcome = estimate_relative_pose(
                keyframe.features, view.features, self._camera, self._tracking_config
            ).outcome
            if isinstance(outcome, Rejection):
                rejections.append(outcome)
                continue
            T_odom_cam = self.map.keyframes[keyframe.id].T_map_cam @ outcome.T_ref_query
            seen_ids = self.map.seen_by([keyframe.id])
            placement = look_around(self.map, view, T_odom_cam, seen_ids, self._tracking_config)
            if isinstance(placement, Placement):
                return placement
            rejections.append(placement)
        return rejections[0]

    def _go_on(self, view: View, placement: Placement) -> TrackedFrame:
        """Remember where the camera is and how it moves; make the view a keyframe if need be."""
        reference = self._recent[-1]
        T_last_cam = se3.inverse(self._T_odom_last) @ placement.T_map_cam
        elapsed_s = view.frame.timestamp_s - self._last_s
        turning_rad_s = float(se3.rotation_angle(T_last_cam)) / elapsed_s
        self._last_s, self._last_ids = view.frame.timestamp_s, placement.pairs[:, 0]
        self._T_odom_last, self._T_last_next = placement.T_map_cam, T_last_cam
        T_kf_cam = se3.inverse(self.map.keyframes[reference.id].T_map_cam) @ placement.T_map_cam
        if not self._needs_keyframe(placement, T_kf_cam):
            return TrackedFrame(reference.id, T_kf_cam)
        keyframe = self._insert(view, placement, turning_rad_s)
        links = self._links(keyframe, reference, with_floor(T_kf_cam, placement.hessian))
        return TrackedFrame(reference.id, T_kf_cam, keyframe, links)

    def _needs_keyframe(self, placement: Placement, T_ref_cam: FloatArray) -> bool:
        seen_by_reference = self.map.seen_by([self._recent[-1].id])
        shared = int(np.count_nonzero(np.isin(placement.pairs[:, 0], seen_by_reference)))
        self._most_shared = max(self._most_shared, shared)
        return bool(
            se3.translation_norm(T_ref_cam) > self._config.keyframe_translation_m
            or np.degrees(se3.rotation_angle(T_ref_cam)) > self._config.keyframe_rotation_deg
            or shared < self._config.keyframe_inlier_share * self._most_shared
        )

    def _insert(self, view: View, placement: Placement, turning_rad_s: float) -> Keyframe:
        """Make a keyframe of the view, which stays where it was placed until the next frame."""
        new_id = self._local_map.insert(
            view.features, view.grid, placement.T_map_cam, placement.pairs
        )
        self._last_s, self._most_shared = view.frame.timestamp_s, 0
        keyframe = Keyframe(
            id=new_id,
            timestamp_s=view.frame.timestamp_s,
            T_odom_cam=placement.T_map_cam,
            features=view.features,
            preview=preview(view.frame),
            turning_rad_s=turning_rad_s,
        )
        self._recent = [*self._recent, keyframe][-1 - self._config.links :]
        return keyframe

    def _links(self, new: Keyframe, reference: Keyframe, motion: RelativePose) -> tuple[Link, ...]:
        """Tie a new keyframe to its reference and to the other recent ones that see the same."""
        motions = [(reference, motion)]
        for earlier in reversed(self._recent[:-1]):
            if earlier.id != reference.id:
                pairs = self.map.shared_features(earlier.id, new.id)
                measured = measure_relative_pose(
                    earlier.features, new.features, pairs, self._camera, self._link_config
                )
                if isinstance(measured.outcome, RelativePose):
                    motions.append((earlier, measured.outcome))
        return tuple(
            Link(each.id, new.id, allow_for_turning(seen, each.turning_rad_s, new.turning_rad_s))
            for each, seen in motions
        )

# SPDX-License-Identifier: Apache-2.0
"""One estimator of the rigid motion between two views, for odometry and for loops alike."""

import numpy as np
from numpy.typing import NDArray

from slam.config import VerificationConfig
from slam.geometry.features import match
from slam.geometry.pnp import pose_by_ransac
from slam.geometry.refinement import Correspondences, refine, residual_lengths
from slam.types import (
    Camera,
    Check,
    Features,
    Rejection,
    RejectionReason,
    RelativePose,
    Verification,
)

_MIN_FOR_POSE = 6
_ENOUGH_DEPTH = 0.5  # share of the matches


def estimate_relative_pose(
    reference: Features,
    query: Features,
    camera: Camera,
    config: VerificationConfig,
    reference_camera: Camera | None = None,
) -> Verification:
    """Return the motion `T_ref_query` between two views, or why there is none, with the evidence.

    Descriptors propose matches, PnP RANSAC finds the motion most of them agree on, and a robust
    least-squares refinement over both views' pixels and depths polishes it. Its information is that
    of the matches alone; `loop_noise` adds what the camera's model leaves out. The camera is the
    query's, and the reference's, too, unless told.
    """
    pairs = match(reference, query, config.max_descriptor_distance)
    has_depth = np.isfinite(reference.depth_m[pairs[:, 0]])
    is_placed = np.isfinite(reference.points_m[pairs[:, 0], 0])
    # Depth of one's own is the better one, and RANSAC's luck the rarer the more matches there are:
    # what other views tell of the reference's points is needed where its depth does not reach.
    is_enough = np.count_nonzero(has_depth) >= _ENOUGH_DEPTH * np.count_nonzero(is_placed)
    pairs = pairs[has_depth if is_enough else is_placed]
    cameras = (reference_camera or camera, camera)
    outcome, inlier_mask, checks = _outcome(reference, query, pairs, cameras, config)
    pixels = np.hstack([reference.pixels[pairs[:, 0]], query.pixels[pairs[:, 1]]])
    return Verification(outcome, pixels, inlier_mask, reference.points_m[pairs[:, 0]], checks)


def _outcome(
    reference: Features,
    query: Features,
    pairs: NDArray[np.int64],
    cameras: tuple[Camera, Camera],
    config: VerificationConfig,
) -> tuple[RelativePose | Rejection, NDArray[np.bool_], tuple[Check, ...]]:
    """Return the motion or why there is none, the (M,) mask of the pairs that agree, the checks."""
    reference_camera, camera = cameras
    nobody = np.zeros(len(pairs), dtype=bool)
    needed = max(config.min_matches, _MIN_FOR_POSE)
    enough = Check.at_least(RejectionReason.FEW_MATCHES, len(pairs), needed)
    if enough.rejection:
        return enough.rejection, nobody, (enough,)
    points_m, pixels = reference.points_m[pairs[:, 0]], query.undistorted_px[pairs[:, 1]]
    found = pose_by_ransac(
        points_m, pixels, camera, config.max_reprojection_px, config.ransac_iterations
    )
    if found is None:
        nothing = Check(RejectionReason.NO_POSE, 0, config.min_inliers, passed=False)
        return Rejection(nothing.reason, 0, nothing.needed), nobody, (enough, nothing)
    T_ref_query, inlier_mask = found
    correspondences = Correspondences.of(reference, query, pairs, camera, reference_camera)
    if np.count_nonzero(inlier_mask) >= _MIN_FOR_POSE:
        # RANSAC's pose comes from three matches; a refined one knows better which others agree.
        T_ref_query, _ = refine(T_ref_query, correspondences.select(inlier_mask), camera)
        lengths = residual_lengths(T_ref_query, correspondences, camera)
        inlier_mask = lengths < config.max_reprojection_px
    pixels = reference.pixels[pairs[:, 0]]
    checks = (enough, *_checks(pixels, inlier_mask, reference_camera, config))
    if rejection := next((each.rejection for each in checks if each.rejection), None):
        return rejection, inlier_mask, checks
    refined = refine(T_ref_query, correspondences.select(inlier_mask), camera)
    return RelativePose(*refined), inlier_mask, checks


def _checks(
    pixels: NDArray[np.float32],
    inlier_mask: NDArray[np.bool_],
    camera: Camera,
    config: VerificationConfig,
) -> tuple[Check, ...]:
    inliers = int(np.count_nonzero(inlier_mask))
    extent = np.ptp(pixels[inlier_mask], axis=0) if inliers else np.zeros(2)
    support = float(extent[0] * extent[1]) / (camera.width * camera.height)
    return (
        Check.at_least(
            RejectionReason.FEW_INLIERS, inliers, max(config.min_inliers, _MIN_FOR_POSE)
        ),
        Check.at_least(
            RejectionReason.LOW_INLIER_RATIO, inliers / len(pixels), config.min_inlier_ratio
        ),
        Check.at_least(RejectionReason.NARROW_SUPPORT, support, config.min_support),
    )

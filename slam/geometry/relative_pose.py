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
    Features,
    Rejection,
    RejectionReason,
    RelativePose,
    Verification,
)

_MIN_FOR_POSE = 6
_ENOUGH_DEPTH = 0.5  # share of the matches


def estimate_relative_pose(
    reference: Features, query: Features, camera: Camera, config: VerificationConfig
) -> Verification:
    """Return the motion `T_ref_query` between two views, or why there is none, with the evidence.

    Descriptors propose matches, PnP RANSAC finds the motion most of them agree on, and a robust
    least-squares refinement over both views' pixels and depths polishes it. Its information is that
    of the matches alone; `loop_noise` adds what the camera's model leaves out.
    """
    pairs = match(reference, query, config.max_descriptor_distance)
    has_depth = np.isfinite(reference.depth_m[pairs[:, 0]])
    is_placed = np.isfinite(reference.points_m[pairs[:, 0], 0])
    # Depth of one's own is the better one, and RANSAC's luck the rarer the more matches there are:
    # what other views tell of the reference's points is needed where its depth does not reach.
    is_enough = np.count_nonzero(has_depth) >= _ENOUGH_DEPTH * np.count_nonzero(is_placed)
    pairs = pairs[has_depth if is_enough else is_placed]
    outcome, inlier_mask = _outcome(reference, query, pairs, camera, config)
    pixels = np.hstack([reference.pixels[pairs[:, 0]], query.pixels[pairs[:, 1]]])
    return Verification(outcome, pixels, inlier_mask, reference.points_m[pairs[:, 0]])


def _outcome(
    reference: Features,
    query: Features,
    pairs: NDArray[np.int64],
    camera: Camera,
    config: VerificationConfig,
) -> tuple[RelativePose | Rejection, NDArray[np.bool_]]:
    """Return the motion or why there is none, and the (M,) mask of the pairs that agree."""
    nobody = np.zeros(len(pairs), dtype=bool)
    needed = max(config.min_matches, _MIN_FOR_POSE)
    if len(pairs) < needed:
        return Rejection(RejectionReason.FEW_MATCHES, len(pairs), needed), nobody
    points_m, pixels = reference.points_m[pairs[:, 0]], query.undistorted_px[pairs[:, 1]]
    found = pose_by_ransac(
        points_m, pixels, camera, config.max_reprojection_px, config.ransac_iterations
    )
    if found is None:
        return Rejection(RejectionReason.NO_POSE, 0, config.min_inliers), nobody
    T_ref_query, inlier_mask = found
    correspondences = Correspondences.of(reference, query, pairs, camera)
    if np.count_nonzero(inlier_mask) >= _MIN_FOR_POSE:
        # RANSAC's pose comes from three matches; a refined one knows better which others agree.
        T_ref_query, _ = refine(T_ref_query, correspondences.select(inlier_mask), camera)
        lengths = residual_lengths(T_ref_query, correspondences, camera)
        inlier_mask = lengths < config.max_reprojection_px
    rejection = _rejection(reference.pixels[pairs[:, 0]], inlier_mask, camera, config)
    if rejection:
        return rejection, inlier_mask
    refined = refine(T_ref_query, correspondences.select(inlier_mask), camera)
    return RelativePose(*refined), inlier_mask


def _rejection(
    pixels: NDArray[np.float32],
    inlier_mask: NDArray[np.bool_],
    camera: Camera,
    config: VerificationConfig,
) -> Rejection | None:
    inliers = int(np.count_nonzero(inlier_mask))
    needed = max(config.min_inliers, _MIN_FOR_POSE)
    if inliers < needed:
        return Rejection(RejectionReason.FEW_INLIERS, inliers, needed)
    ratio = inliers / len(pixels)
    if ratio < config.min_inlier_ratio:
        return Rejection(RejectionReason.LOW_INLIER_RATIO, ratio, config.min_inlier_ratio)
    extent = np.ptp(pixels[inlier_mask], axis=0)
    support = float(extent[0] * extent[1]) / (camera.width * camera.height)
    if support < config.min_support:
        return Rejection(RejectionReason.NARROW_SUPPORT, support, config.min_support)
    return None

# SPDX-License-Identifier: Apache-2.0
"""Asks geometry whether two keyframes show the same place."""

import numpy as np

from slam.config import VerificationConfig
from slam.geometry.motion_noise import loop_noise, translation_sigma_m, typical_depth_m
from slam.geometry.relative_pose import estimate_relative_pose
from slam.loops.submaps import Loop
from slam.types import (
    Camera,
    Check,
    Keyframe,
    Rejection,
    RejectionReason,
    RelativePose,
    Verification,
)


def verify_loop(
    match: Keyframe, query: Keyframe, camera: Camera, config: VerificationConfig | None = None
) -> Loop | Rejection:
    """Return the loop that two keyframes of any two maps make by geometry, or why they make none.

    It is verified as every loop of a run. The camera took those keyframes that do not name theirs.
    """
    seen, outcome, _ = verified(match, query, camera, config or VerificationConfig())
    if isinstance(outcome, Rejection):
        return outcome
    points_ref_m = seen.points_ref_m[seen.inlier_mask].astype(np.float64)
    return Loop.of(match.id, query.id, outcome, points_ref_m)


def verified(
    match: Keyframe, query: Keyframe, camera: Camera, config: VerificationConfig
) -> tuple[Verification, RelativePose | Rejection, tuple[Check, ...]]:
    """Return what geometry saw of two keyframes, the motion that it finds or why none, and checks.

    The camera took those keyframes that do not name theirs.
    """
    ours, theirs = (each.camera or camera for each in (query, match))
    verification = estimate_relative_pose(match.features, query.features, ours, config, theirs)
    outcome, checks = verification.outcome, verification.checks
    if isinstance(outcome, RelativePose):
        depth_m = typical_depth_m(match.features, query.features)
        turning = (match.turning_rad_s, query.turning_rad_s)
        # Of two cameras the worse one tells what their models leave out.
        noisy = [loop_noise(outcome, each, depth_m, *turning) for each in (ours, theirs)]
        outcome = max(noisy, key=translation_sigma_m)
        share, most = translation_sigma_m(outcome) / depth_m, config.max_uncertainty
        certain = Check(RejectionReason.UNCERTAIN_MOTION, share, most, bool(share <= most))
        checks += (certain,)
        outcome = certain.rejection or outcome
    return verification, outcome, checks

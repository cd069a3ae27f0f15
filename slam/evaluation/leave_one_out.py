# SPDX-License-Identifier: Apache-2.0
"""Which loops ground truth says helped: the error of the map without each."""

import numpy as np

from slam.evaluation.trajectory import MIN_ALIGNED, align, associate
from slam.geometry import se3
from slam.result import SlamResult
from slam.types import FloatArray, Trajectory


def helped_m(result: SlamResult, truth: Trajectory, max_time_difference_s: float) -> FloatArray:
    """Return (A,), how much larger the keyframes' ATE would be without each loop attempt, metres.

    NaN where a loop is not in use, or too few keyframes have a true pose.
    """
    helped = np.full(len(result.attempts), np.nan)
    stamps_s = np.array([each.timestamp_s for each in result.keyframes])
    placed = np.flatnonzero(np.isfinite(result.T_world_kf[:, 0, 0]))
    placed = placed[placed >= result.earlier]  # of those the truth of this run is
    estimate = Trajectory(stamps_s[placed], result.T_world_kf[placed])
    in_estimate, in_truth = associate(estimate, truth, max_time_difference_s)
    if len(in_estimate) < MIN_ALIGNED:
        return helped
    ids, true_m = placed[in_estimate], truth.T_world_cam[in_truth, :3, 3]
    positions_m = result.T_world_kf[ids, :3, 3]
    with_all_m = _ate_m(positions_m, true_m)
    for n, attempt in enumerate(result.attempts):
        if influence := attempt.influence:
            moved_m = np.zeros((len(result.keyframes), 3))
            moved_m[influence.keyframe_ids] = influence.moved_m
            helped[n] = _ate_m(positions_m - moved_m[ids], true_m) - with_all_m
    return helped


def _ate_m(positions_m: FloatArray, true_m: FloatArray) -> float:
    aligned_m = se3.transform(align(positions_m, true_m), positions_m)
    return float(np.sqrt(((aligned_m - true_m) ** 2).sum(axis=1).mean()))

# SPDX-License-Identifier: Apache-2.0
"""Drift per metre: how wrong the motion over the last metre travelled is."""

import numpy as np

from slam.evaluation.trajectory import associate
from slam.geometry import se3
from slam.types import FloatArray, Trajectory


def drift_per_metre(
    estimate: Trajectory,
    truth: Trajectory,
    tolerance_s: float,
    session_starts_s: FloatArray,
    over_m: float = 1.0,
) -> FloatArray:
    """Return (N,) the position error per metre of the motion that ends at each pose.

    It is the relative pose error over the last stretch of so many metres of the true path (Geiger
    et al., Are we ready for Autonomous Driving?, CVPR 2012), which needs no alignment; NaN where
    truth does not reach back so far in the same session.
    """
    errors = np.full(len(estimate), np.nan)
    in_estimate, in_truth = associate(estimate, truth, tolerance_s)
    if len(in_estimate) == 0:
        return errors
    T_true, T_found = truth.T_world_cam[in_truth], estimate.T_world_cam[in_estimate]
    steps_m = np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    first = np.searchsorted(travelled_m, travelled_m - over_m, side="right") - 1
    session = np.searchsorted(session_starts_s, estimate.timestamps_s[in_estimate], side="right")
    last = np.flatnonzero((first >= 0) & (session[first] == session))
    first = first[last]
    true, found = (se3.inverse(T[first]) @ T[last] for T in (T_true, T_found))
    lengths_m = travelled_m[last] - travelled_m[first]
    errors[in_estimate[last]] = se3.translation_norm(se3.inverse(true) @ found) / lengths_m
    return errors

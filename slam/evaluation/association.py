# SPDX-License-Identifier: Apache-2.0
"""Which poses of two trajectories belong together, and what of each is left out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.evaluation.coverage import coverage, gaps, outside_breaks, sessions
from slam.evaluation.trajectory import associate, path_length_m
from slam.types import FloatArray, IntArray, SlamError, Trajectory


@dataclass(frozen=True)
class Association:
    """Which poses were compared, and which were not.

    Attributes:
        by_row: there are no times; poses belong together by their number.
        estimate_poses, truth_poses, matched: counts.
        most_apart_s: of two that belong together; NaN by row.
        truth_covers: share of the estimate's time for which there is truth, gaps of more than half
            a second left out; NaN by row.
        estimate_covers: share of the truth's time for which there is an estimate; alike.
        missing_s: (G, 2) seconds, the stretches of the truth's time without an estimate.
        span_s: the truth's time; NaN by row.
        estimate_length_m, truth_length_m: of the way through the matched poses.

    The breaks between recordings are no part of any of these.
    """

    by_row: bool
    estimate_poses: int
    truth_poses: int
    matched: int
    most_apart_s: float
    truth_covers: float
    estimate_covers: float
    missing_s: FloatArray
    span_s: float
    estimate_length_m: float
    truth_length_m: float


def associated(
    estimate: Trajectory,
    truth: Trajectory,
    tolerance_s: float,
    by_row: bool,
    starts_s: Sequence[float],
) -> tuple[Association, Trajectory, Trajectory]:
    """Return which poses belong together, and those of the estimate and the truth that do.

    Raises:
        SlamError: they belong together by row, and one has more rows.
    """
    most_apart_s, span_s, missing_s = np.nan, np.nan, np.zeros((0, 2))
    truth_covers = estimate_covers = np.nan
    if by_row:
        if len(estimate) != len(truth):
            raise SlamError(
                f"without times poses belong together by their row, but there are {len(estimate)}"
                f" of the estimate and {len(truth)} of the truth; give files with times"
            )
        rows = np.arange(len(estimate), dtype=np.float64)
        matched, true = (Trajectory(rows, each.T_world_cam) for each in (estimate, truth))
    else:
        in_estimate, in_truth = associate(estimate, truth, tolerance_s)
        matched, true = _rows(estimate, in_estimate), _rows(truth, in_truth)
        apart_s = np.abs(matched.timestamps_s - true.timestamps_s)
        most_apart_s = float(apart_s.max(initial=0.0))
        of_truth = outside_breaks(truth, estimate, starts_s)
        parts = sessions(of_truth, starts_s)
        truth_covers = coverage(estimate, truth, starts_s)
        estimate_covers = coverage(of_truth, estimate, starts_s)
        missing_s = np.concatenate([missing_s, *(gaps(estimate, part) for part in parts)])
        span_s = float(sum(part.timestamps_s[-1] - part.timestamps_s[0] for part in parts))
    association = Association(
        by_row,
        len(estimate),
        len(truth),
        len(matched),
        most_apart_s,
        truth_covers,
        estimate_covers,
        missing_s,
        span_s,
        _way_m(matched, starts_s),
        # By the estimate's times, so that each true pose is in the session of its own.
        _way_m(Trajectory(matched.timestamps_s, true.T_world_cam), starts_s),
    )
    return association, matched, true


def _way_m(trajectory: Trajectory, starts_s: Sequence[float]) -> float:
    return sum(path_length_m(each) for each in sessions(trajectory, starts_s))


def _rows(trajectory: Trajectory, rows: IntArray) -> Trajectory:
    return Trajectory(trajectory.timestamps_s[rows], trajectory.T_world_cam[rows])

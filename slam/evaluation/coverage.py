# SPDX-License-Identifier: Apache-2.0
"""How much of the time of one trajectory another one has poses for."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from slam.types import FloatArray, Trajectory

MAX_GAP_S = 0.5
"""A trajectory without a pose for longer than this counts as interrupted."""


def coverage(
    estimate: Trajectory, truth: Trajectory, session_starts_s: Sequence[float] | FloatArray = ()
) -> float:
    """Return the share of an estimate's time span, 0 to 1, during which there is ground truth.

    The breaks before sessions that start later are no part of it.
    """
    is_covered = np.diff(truth.timestamps_s) <= MAX_GAP_S
    covered_s = total_s = 0.0
    for session in sessions(estimate, session_starts_s):
        start_s, end_s = session.timestamps_s[0], session.timestamps_s[-1]
        stamps_s = np.clip(truth.timestamps_s, start_s, end_s)
        covered_s += float(np.diff(stamps_s)[is_covered].sum())
        total_s += end_s - start_s
    return covered_s / total_s if total_s > 0.0 else 0.0


def gaps(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Return (G, 2) when each stretch of the truth's time without an estimate begins and ends."""
    start_s, end_s = truth.timestamps_s[0], truth.timestamps_s[-1]
    stamps_s = np.clip(estimate.timestamps_s, start_s, end_s)
    edges_s = np.concatenate([[start_s], stamps_s, [end_s]])
    is_gap = np.diff(edges_s) > MAX_GAP_S
    return np.column_stack([edges_s[:-1][is_gap], edges_s[1:][is_gap]])


def outside_breaks(
    truth: Trajectory, estimate: Trajectory, session_starts_s: Sequence[float] | FloatArray
) -> Trajectory:
    """Return a truth without what lies between a session's last estimate and the next session.

    A session without any estimate keeps all of its truth: when it ended is not known.
    """
    is_kept = np.ones(len(truth), dtype=bool)
    for start_s, next_s in pairwise([-np.inf, *session_starts_s]):
        stamps_s = estimate.timestamps_s
        of_session_s = stamps_s[(stamps_s >= start_s) & (stamps_s < next_s)]
        end_s = of_session_s.max(initial=-np.inf)
        if np.isfinite(end_s):
            is_kept &= (truth.timestamps_s <= end_s) | (truth.timestamps_s >= next_s)
    return Trajectory(truth.timestamps_s[is_kept], truth.T_world_cam[is_kept])


def sessions(
    trajectory: Trajectory, session_starts_s: Sequence[float] | FloatArray
) -> list[Trajectory]:
    """Return the parts of a trajectory that lie between the starts of sessions."""
    splits = np.searchsorted(trajectory.timestamps_s, session_starts_s)
    columns = (np.split(each, splits) for each in vars(trajectory).values())
    return [Trajectory(*part) for part in zip(*columns, strict=True) if len(part[0])]

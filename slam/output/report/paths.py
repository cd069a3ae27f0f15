# SPDX-License-Identifier: Apache-2.0
"""The camera paths of a run in one common frame, ready to be drawn."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.drift import DriftReport
from slam.result import SlamResult
from slam.types import FloatArray, Trajectory

GAP_FACTOR = 5.0
"""Frames further apart than this many median intervals are not joined by a line."""


SESSION_GAP_S = 1.0
"""What the time axis shows of the break between two sessions."""


@dataclass(frozen=True)
class Paths:
    """Positions before and after loop closure and in truth, metres, in one frame.

    Attributes:
        times_s: (N,) elapsed; before_m, after_m: (N, 3).
        keyframes_m: (K, 3) corrected; keyframe_times_s: (K,).
        truth_m: (M, 3), empty without ground truth; truth_times_s: (M,) with the breaks left in.
        keyframe_truth_m: (K, 3), NaN where ground truth has no pose in time.
        lost_s: (L,) when frames could not be tracked.
        session_starts_s: (S,) timestamp of the first frame of each session.
        breaks_s: (S,) what is left out before each session so that they follow one another.
        in_truth_frame: whether the frame is ground truth's, not the first keyframe's camera.
    """

    times_s: FloatArray
    before_m: FloatArray
    after_m: FloatArray
    keyframes_m: FloatArray
    keyframe_times_s: FloatArray
    truth_m: FloatArray
    truth_times_s: FloatArray
    keyframe_truth_m: FloatArray
    lost_s: FloatArray
    session_starts_s: FloatArray
    breaks_s: FloatArray
    in_truth_frame: bool

    def elapsed_s(self, timestamps_s: FloatArray) -> FloatArray:
        """Return (N,) seconds since the first frame, without the breaks between sessions."""
        return _elapsed_s(timestamps_s, self.session_starts_s, self.breaks_s)

    @property
    def session_starts(self) -> NDArray[np.int64]:
        """The first placed frame of each session that has one."""
        starts = np.searchsorted(self.times_s, self.elapsed_s(self.session_starts_s))
        return np.unique(starts[starts < len(self.times_s)])

    @property
    def has_keyframe_truth(self) -> bool:
        """Whether ground truth knows where any keyframe was."""
        return bool(np.isfinite(self.keyframe_truth_m).any())

    @property
    def axes(self) -> tuple[int, int, int]:
        """The three coordinate axes, those with the most motion first."""
        spread = np.ptp(self.after_m, axis=0) if len(self.after_m) else np.zeros(3)
        first, second, third = (int(axis) for axis in np.argsort(-spread, kind="stable"))
        return first, second, third


def gather(result: SlamResult, drift: DriftReport | None, truth: Trajectory | None) -> Paths:
    """Return the paths of a run, each aligned to ground truth where a drift report says how."""
    to_truth_before = drift.before.T_truth_world if drift is not None else np.eye(4)
    to_truth_after = drift.after.T_truth_world if drift is not None else np.eye(4)
    if drift is None or truth is None or len(truth) == 0:
        truth = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    keyframe_times = np.array([keyframe.timestamp_s for keyframe in result.keyframes])
    times = result.trajectory.timestamps_s
    frames = np.unique(np.concatenate([times, keyframe_times, result.untracked_s]))
    starts, breaks = _sessions(frames, result.session_starts_s)
    tolerance = drift.tolerance_s if drift is not None else 0.0
    inside = _within(truth.timestamps_s, times, starts)
    return Paths(
        times_s=_elapsed_s(times, starts, breaks),
        before_m=_positions(to_truth_before, result.odometry.T_world_cam),
        after_m=_positions(to_truth_after, result.trajectory.T_world_cam),
        keyframes_m=_positions(to_truth_after, result.T_world_kf),
        keyframe_times_s=_elapsed_s(keyframe_times, starts, breaks),
        truth_m=truth.T_world_cam[inside, :3, 3],
        truth_times_s=truth.timestamps_s[inside] - starts[0],
        keyframe_truth_m=positions_at(truth, keyframe_times, tolerance),
        lost_s=_elapsed_s(result.untracked_s, starts, breaks),
        session_starts_s=starts,
        breaks_s=breaks,
        in_truth_frame=drift is not None,
    )


def _sessions(times_s: FloatArray, later_starts_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return when all sessions start, and what to leave out before each of them."""
    ends_s = times_s[np.searchsorted(times_s, later_starts_s) - 1]
    breaks_s = np.maximum(later_starts_s - ends_s - SESSION_GAP_S, 0.0)
    return np.append(times_s[0], later_starts_s), np.append(0.0, breaks_s)


def _elapsed_s(times_s: FloatArray, starts_s: FloatArray, breaks_s: FloatArray) -> FloatArray:
    session = np.maximum(np.searchsorted(starts_s, times_s, side="right") - 1, 0)
    return np.asarray(times_s - starts_s[0] - np.cumsum(breaks_s)[session])


def positions_at(trajectory: Trajectory, times_s: FloatArray, tolerance_s: float) -> FloatArray:
    """Return the (N, 3) positions nearest in time, NaN where none is within the tolerance."""
    found = np.full((len(times_s), 3), np.nan)
    if len(trajectory) == 0:
        return found
    right = np.searchsorted(trajectory.timestamps_s, times_s).clip(0, len(trajectory) - 1)
    left = (right - 1).clip(0)
    gap_left = np.abs(trajectory.timestamps_s[left] - times_s)
    gap_right = np.abs(trajectory.timestamps_s[right] - times_s)
    nearest = np.where(gap_left < gap_right, left, right)
    near = np.minimum(gap_left, gap_right) <= tolerance_s
    found[near] = trajectory.T_world_cam[nearest[near], :3, 3]
    return found


def broken(times_s: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Return times and values with NaN between frames that are far apart, to break the line."""
    steps = np.diff(times_s)
    if len(steps) == 0:
        return (times_s, *values)
    cuts = np.flatnonzero(steps > GAP_FACTOR * np.median(steps)) + 1
    return tuple(np.insert(array, cuts, np.nan, axis=0) for array in (times_s, *values))


def _within(truth_s: FloatArray, times_s: FloatArray, starts_s: FloatArray) -> NDArray[np.bool_]:
    """Return (M,) bool, the true poses from the first to the last frame of a session."""
    inside = np.zeros(len(truth_s), dtype=bool)
    for part_s in np.split(times_s, np.searchsorted(times_s, starts_s[1:])):
        if len(part_s):
            inside |= (truth_s >= part_s[0]) & (truth_s <= part_s[-1] + 1e-9)
    return inside


def _positions(T_truth_world: FloatArray, T_world_cam: FloatArray) -> FloatArray:
    return T_world_cam[:, :3, 3] @ T_truth_world[:3, :3].T + T_truth_world[:3, 3]

# SPDX-License-Identifier: Apache-2.0
"""The camera paths of a run in one common frame, ready to be drawn."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from placerec.datasets.tum_lists import nearest
from slam.evaluation.drift import DriftReport
from slam.geometry import se3
from slam.result import SlamResult
from slam.types import FloatArray, IntArray, Trajectory

_GAP_FACTOR = 5.0
"""Frames further apart than this many median intervals are not joined by a line."""

SESSION_GAP_S = 1.0
"""What the time axis shows of the break between two sessions."""


@dataclass(frozen=True)
class Paths:
    """Positions before and after loop closure and in truth, metres, in one frame.

    Attributes:
        elapsed_s: takes (N,) timestamps to (N,) seconds since the first frame, without the breaks
            between sessions.
        times_s: (N,) elapsed; before_m, after_m: (N, 3).
        keyframes_m: (K, 3) corrected.
        truth_m: (M, 3), empty without ground truth; truth_times_s: (M,) with the breaks left in.
        keyframe_truth_m: (K, 3), NaN where ground truth has no pose in time.
        lost_s: (L,) elapsed when frames could not be tracked.
        session_starts_s: (S,) elapsed when each session starts.
        in_truth_frame: whether the frame is ground truth's, not the first keyframe's camera.
    """

    elapsed_s: Callable[[FloatArray], FloatArray]
    times_s: FloatArray
    before_m: FloatArray
    after_m: FloatArray
    keyframes_m: FloatArray
    truth_m: FloatArray
    truth_times_s: FloatArray
    keyframe_truth_m: FloatArray
    lost_s: FloatArray
    session_starts_s: FloatArray
    in_truth_frame: bool

    @property
    def session_starts(self) -> IntArray:
        """The first placed frame of each session that has one."""
        starts = np.searchsorted(self.times_s, self.session_starts_s)
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
    to_truth_before = drift.odometry.T_truth_world if drift is not None else np.eye(4)
    to_truth_after = drift.corrected.T_truth_world if drift is not None else np.eye(4)
    stamps_s = result.trajectory.timestamps_s
    keyframes_s = np.array([keyframe.timestamp_s for keyframe in result.keyframes])
    frames_s = np.unique(np.concatenate([stamps_s, keyframes_s, result.untracked_s]))
    later_s = result.session_starts_s
    starts_s = np.append(frames_s[0], later_s)
    ends_s = frames_s[np.searchsorted(frames_s, later_s) - 1]
    breaks_s = np.append(0.0, np.maximum(later_s - ends_s - SESSION_GAP_S, 0.0))

    def elapsed_s(times_s: FloatArray) -> FloatArray:
        session = np.maximum(np.searchsorted(starts_s, times_s, side="right") - 1, 0)
        return np.asarray(times_s - starts_s[0] - np.cumsum(breaks_s)[session])

    truth_times_s, truth_m = np.empty(0), np.empty((0, 3))
    keyframe_truth_m = np.full((len(keyframes_s), 3), np.nan)
    if drift is not None and truth is not None and len(truth):
        inside = np.zeros(len(truth), dtype=bool)
        for session_s in np.split(stamps_s, np.searchsorted(stamps_s, later_s)):
            if len(session_s):
                first_s, last_s = session_s[0], session_s[-1] + 1e-9
                inside |= (truth.timestamps_s >= first_s) & (truth.timestamps_s <= last_s)
        truth_m = truth.T_world_cam[inside, :3, 3]
        truth_times_s = truth.timestamps_s[inside] - starts_s[0]
        closest = nearest(truth.timestamps_s, keyframes_s)
        is_near = np.abs(truth.timestamps_s[closest] - keyframes_s) <= drift.tolerance_s
        keyframe_truth_m[is_near] = truth.T_world_cam[closest[is_near], :3, 3]
    return Paths(
        elapsed_s=elapsed_s,
        times_s=elapsed_s(stamps_s),
        before_m=se3.transform(to_truth_before, result.odometry.T_world_cam[:, :3, 3]),
        after_m=se3.transform(to_truth_after, result.corrected.T_world_cam[:, :3, 3]),
        keyframes_m=se3.transform(to_truth_after, result.T_world_kf[:, :3, 3]),
        truth_m=truth_m,
        truth_times_s=truth_times_s,
        keyframe_truth_m=keyframe_truth_m,
        lost_s=elapsed_s(result.untracked_s),
        session_starts_s=elapsed_s(starts_s),
        in_truth_frame=drift is not None,
    )


def broken(times_s: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Return times and values with NaN between frames that are far apart, to break the line."""
    steps = np.diff(times_s)
    if len(steps) == 0:
        return (times_s, *values)
    cuts = np.flatnonzero(steps > _GAP_FACTOR * np.median(steps)) + 1
    return tuple(np.insert(array, cuts, np.nan, axis=0) for array in (times_s, *values))

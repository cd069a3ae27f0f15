# SPDX-License-Identifier: Apache-2.0
"""The camera paths of a run in one common frame, ready to be drawn."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam.evaluation.drift import DriftReport
from slam.evaluation.trajectory import associate
from slam.result import SlamResult
from slam.types import FloatArray, IntArray

_GAP_FACTOR = 5.0
"""Frames further apart than this many median intervals are not joined by a line."""

SESSION_GAP_S = 1.0
"""What the time axis shows of the break between two sessions."""

_FACTORS = (100, 50, 20, 10, 5, 2)
_SHOWN_DRIFT = 0.1
"""Drift is enlarged until it would be more than this share of the path's extent."""


@dataclass(frozen=True)
class Paths:
    """Camera poses at N frames, of tracking alone and in the end, in one frame; and what is true.

    Attributes:
        elapsed_s: takes (N,) timestamps to (N,) seconds since the first frame, without the breaks
            between sessions.
        times_s: (N,) elapsed.
        odometry, without_loops, corrected: (N, 4, 4).
        truth_m: (N, 3), NaN where ground truth has no pose in time.
        keyframe_frames: (K,) the frame that each keyframe is, -1 where it has no place.
        lost_s: (L,) elapsed when frames could not be placed.
        session_starts_s: (S,) elapsed when each session starts.
        in_truth_frame: whether the frame is ground truth's, not the first keyframe's camera.
    """

    elapsed_s: Callable[[FloatArray], FloatArray]
    times_s: FloatArray
    odometry: FloatArray
    without_loops: FloatArray
    corrected: FloatArray
    truth_m: FloatArray
    keyframe_frames: IntArray
    lost_s: FloatArray
    session_starts_s: FloatArray
    in_truth_frame: bool

    @property
    def stages(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The poses in the order in which the path came about."""
        return self.odometry, self.without_loops, self.corrected

    @property
    def keyframes_m(self) -> FloatArray:
        """(K, 3) corrected, NaN where there is no place."""
        return at_keyframes(self.corrected[:, :3, 3], self.keyframe_frames)

    @property
    def keyframe_truth_m(self) -> FloatArray:
        """(K, 3), NaN where ground truth has no pose in time."""
        return at_keyframes(self.truth_m, self.keyframe_frames)

    @property
    def has_keyframe_truth(self) -> bool:
        """Whether ground truth knows where any keyframe was."""
        return bool(np.isfinite(self.keyframe_truth_m).any())

    @property
    def session_starts(self) -> IntArray:
        """The first placed frame of each session that has one."""
        starts = np.searchsorted(self.times_s, self.session_starts_s)
        return np.unique(starts[starts < len(self.times_s)])

    @property
    def breaks(self) -> IntArray:
        """The frames that are too long after the one before to be joined to it."""
        steps = np.diff(self.times_s)
        if len(steps) == 0:
            return np.zeros(0, np.int64)
        return np.flatnonzero(steps > _GAP_FACTOR * np.median(steps)) + 1

    def breaks_among(self, chosen: IntArray) -> IntArray:
        """Return which of some frames, in order, have a break between the one before and them."""
        return np.unique(np.searchsorted(chosen, self.breaks))

    @property
    def travelled_m(self) -> FloatArray:
        """(N,) length of the corrected path until each frame."""
        steps = np.linalg.norm(np.diff(self.corrected[:, :3, 3], axis=0), axis=1)
        return np.concatenate([np.zeros(min(1, len(self.times_s))), np.cumsum(steps)])

    @property
    def up(self) -> FloatArray:
        """(3,) the axis, with its sign, that points up most: cameras are held upright."""
        upwards = -self.corrected[:, :3, 1].mean(axis=0) if len(self.times_s) else np.zeros(3)
        axis = int(np.argmax(np.abs(upwards)))
        return np.asarray(np.eye(3)[axis] * (1.0 if upwards[axis] >= 0.0 else -1.0))

    @property
    def reference_m(self) -> FloatArray:
        """(N, 3) what drift is drawn from: truth where it is known, the corrected path if none is.

        NaN where some is known, but not there.
        """
        has_truth = np.isfinite(self.truth_m).any()
        return self.truth_m if has_truth else self.corrected[:, :3, 3]

    @property
    def enlargement(self) -> int:
        """By how much drift has to be enlarged for paths to be told apart."""
        far_m = [stage[:, :3, 3] - self.reference_m for stage in self.stages]
        most_m = np.nanmax(np.abs(far_m), initial=0.0)
        if most_m == 0.0:
            return 1
        extent_m = np.ptp(self.corrected[:, :3, 3], axis=0).max() if len(self.times_s) else 0.0
        return next((k for k in _FACTORS if k * most_m <= _SHOWN_DRIFT * extent_m), 1)

    def enlarged(self, points_m: FloatArray, factor: float) -> FloatArray:
        """Return (N, 3) points so many times as far from the reference, where that is known."""
        drift_m = points_m - self.reference_m
        return np.where(np.isfinite(drift_m), self.reference_m + factor * drift_m, points_m)


def at_keyframes(values: FloatArray, frames: IntArray) -> FloatArray:
    """Return (K, ...) of (N, ...) values those of the keyframes, NaN for those without a place."""
    chosen = np.full((len(frames), *values.shape[1:]), np.nan)
    chosen[frames >= 0] = values[frames[frames >= 0]]
    return chosen


def gather(result: SlamResult, drift: DriftReport | None) -> Paths:
    """Return the paths of a run, each aligned to ground truth where a drift report says how."""
    corrected = result.corrected
    stamps_s = corrected.timestamps_s
    keyframes_s = np.array([keyframe.timestamp_s for keyframe in result.keyframes])
    own_s = keyframes_s[result.earlier :]
    frames_s = np.unique(np.concatenate([stamps_s, own_s, result.untracked_s]))
    later_s = result.session_starts_s
    starts_s = np.append(frames_s[0], later_s)
    ends_s = frames_s[np.searchsorted(frames_s, later_s) - 1]
    breaks_s = np.append(0.0, np.maximum(later_s - ends_s - SESSION_GAP_S, 0.0))

    def elapsed_s(times_s: FloatArray) -> FloatArray:
        session = np.maximum(np.searchsorted(starts_s, times_s, side="right") - 1, 0)
        return np.asarray(times_s - starts_s[0] - np.cumsum(breaks_s)[session])

    frame = np.searchsorted(stamps_s, keyframes_s).clip(max=len(stamps_s) - 1)
    is_drawn = (stamps_s[frame] == keyframes_s) & (np.arange(len(frame)) >= result.earlier)
    truth_m = np.full((len(stamps_s), 3), np.nan)
    if drift is not None:
        matched, in_truth = associate(corrected, drift.truth, drift.tolerance_s)
        truth_m[matched] = drift.truth.T_world_cam[in_truth, :3, 3]
    odometry, without_loops = result.odometry.T_world_cam, result.without_loops.T_world_cam
    return Paths(
        elapsed_s=elapsed_s,
        times_s=elapsed_s(stamps_s),
        odometry=drift.odometry.T_truth_world @ odometry if drift else odometry,
        without_loops=drift.without_loops.T_truth_world @ without_loops if drift else without_loops,
        corrected=(drift.corrected.T_truth_world if drift else np.eye(4)) @ corrected.T_world_cam,
        truth_m=truth_m,
        keyframe_frames=np.where(is_drawn, frame, -1),
        lost_s=elapsed_s(result.untracked_s),
        session_starts_s=elapsed_s(starts_s),
        in_truth_frame=drift is not None,
    )

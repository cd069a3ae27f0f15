# SPDX-License-Identifier: Apache-2.0
"""Every frame and the keyframe it was placed against: it is corrected when the keyframe is."""

from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from slam.external_odometry.given_poses import poses_between
from slam.geometry import se3
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import FloatArray, IntArray, Trajectory

# Where for so many frames only features in so little of the image agree, those in the rest of it
# may be the ones that stand still.
_WHILE, _LITTLE = 15, 0.5


@dataclass(frozen=True)
class LoggedFrames:
    """N frames that were placed against keyframes, in the order of time.

    Attributes:
        timestamps_s: (N,) seconds.
        keyframe_id: (N,) the keyframe, the frame itself where it became one.
        T_kf_cam: (N, 4, 4), in the keyframe's camera frame.
        segment: (N,) the keyframe's.
        T_odom_cam: (N, 4, 4), as it was known when the frame was tracked.
        newest_id: (N,) the newest keyframe then.
        covered: (N,) in which share of the image features agree on where it was taken.
    """

    timestamps_s: FloatArray
    keyframe_id: IntArray
    T_kf_cam: FloatArray
    segment: IntArray
    T_odom_cam: FloatArray
    newest_id: IntArray
    covered: FloatArray

    def select(self, chosen: NDArray[np.bool_]) -> "LoggedFrames":
        """Return those of an (N,) mask."""
        return LoggedFrames(
            **{each.name: getattr(self, each.name)[chosen] for each in fields(self)}
        )


class FrameLog:
    """Every frame of a run: placed against a keyframe, or lost.

    What is known of a frame is kept in columns of plain numbers, some 300 bytes in all.

    Attributes:
        last_s: when the last frame came, whatever became of it; -inf before there is one.
        session_starts_s: when the first frame of each session after the first came.
    """

    def __init__(self, before: Sequence[int] = ()) -> None:
        """Begin; of an earlier map is told how many frames were placed against each keyframe."""
        self.last_s = -np.inf
        self.session_starts_s: list[float] = []
        self._is_new_session = False
        self._before = Counter(dict(enumerate(before)))
        self._newest_before = len(before) - 1
        self._timestamps_s, self._covered = array("d"), array("d")
        self._keyframe_ids, self._segments, self._newest_ids = array("q"), array("q"), array("q")
        self._T_kf_cam, self._T_odom_cam = array("d"), array("d")
        # (4, 4) motions of a new keyframe, by its id and that of the other one.
        self._T_ref_kf: dict[tuple[int, int], FloatArray] = {}
        self._lost_s: list[float] = []

    def start_session(self) -> None:
        """Take the next frame for the first of another recording."""
        self._is_new_session = self.last_s > -np.inf

    def expect(self, timestamp_s: float) -> None:
        """Note that a frame came, of which is not known yet whether it can be placed."""
        self.last_s = timestamp_s
        if self._is_new_session:
            self.session_starts_s.append(timestamp_s)
            self._is_new_session = False

    def add(self, timestamp_s: float, tracked: TrackedFrame) -> None:
        """Remember a frame by its place in a keyframe's camera frame, and by where it was then."""
        newest_id = self._newest_ids[-1] if self._newest_ids else self._newest_before
        if tracked.new_keyframe:
            newest_id = tracked.new_keyframe.id
        self._timestamps_s.append(timestamp_s)
        self._keyframe_ids.append(tracked.keyframe_id)
        self._segments.append(tracked.segment)
        self._newest_ids.append(newest_id)
        self._covered.append(tracked.covered)
        self._T_kf_cam.frombytes(np.asarray(tracked.T_kf_cam, np.float64).tobytes())
        self._T_odom_cam.frombytes(np.asarray(tracked.T_odom_cam, np.float64).tobytes())
        for link in tracked.links:
            self._T_ref_kf[newest_id, link.ref_id] = link.motion.T_ref_query

    @property
    def segment(self) -> int | None:
        """The segment of the last frame that was placed, None before there is one."""
        return self._segments[-1] if self._segments else None

    def lose(self, timestamp_s: float) -> None:
        """Remember a frame that could not be placed."""
        self._lost_s.append(timestamp_s)

    def per_keyframe(self) -> Counter[int]:
        """Return how many frames were placed against each keyframe id, of an earlier map, too."""
        return self._before + Counter(self._keyframe_ids)

    @property
    def placed(self) -> LoggedFrames:
        """All frames that were placed."""
        return LoggedFrames(
            timestamps_s=self.placed_s,
            keyframe_id=np.array(self._keyframe_ids, np.int64),
            T_kf_cam=np.array(self._T_kf_cam).reshape(-1, 4, 4),
            segment=np.array(self._segments, np.int64),
            T_odom_cam=np.array(self._T_odom_cam).reshape(-1, 4, 4),
            newest_id=np.array(self._newest_ids, np.int64),
            covered=np.array(self._covered),
        )

    def trajectory(self, T_any_kf: FloatArray) -> Trajectory:
        """Return the frames whose keyframe is among (K, 4, 4) poses and not NaN there.

        Where the poses bend the motion from one keyframe to the next, the frames between them share
        the bend in proportion to time.
        """
        frames = self._on(np.isfinite(T_any_kf[:, 0, 0]))
        T_any_cam = T_any_kf[frames.keyframe_id] @ frames.T_kf_cam
        self._share_bends(frames, T_any_kf, T_any_cam)
        return Trajectory(frames.timestamps_s, T_any_cam)

    def _share_bends(
        self, frames: LoggedFrames, T_any_kf: FloatArray, T_any_cam: FloatArray
    ) -> None:
        """Bend (N, 4, 4) poses of frames after a keyframe towards the next one, each by its share.

        There is no bend to share where frames in between were placed against another keyframe, or
        no link says how the odometry came from the one to the other.
        """
        newest, ids = frames.newest_id, frames.keyframe_id
        ends = 1 + np.flatnonzero((np.diff(newest) != 0) & (newest == ids)[1:])
        starts = np.concatenate([np.zeros(1, np.int64), ends])[:-1]
        spans = zip(ids[starts].tolist(), ids[ends].tolist(), strict=True)
        motions = [self._T_ref_kf.get((end, start)) for start, end in spans]
        # How many frames until each were placed against another keyframe than the one before them.
        changes = np.concatenate([np.zeros(1, np.int64), np.cumsum(np.diff(ids) != 0)])
        is_bent = (ends - starts >= 2) & (changes[ends - 1] == changes[starts])
        is_bent &= np.array([each is not None for each in motions], bool)
        if not is_bent.any():
            return
        starts, ends = starts[is_bent], ends[is_bent]
        T_kf_end = np.array([T for T, chosen in zip(motions, is_bent, strict=True) if chosen])
        T_any_end = T_any_kf[ids[starts]] @ T_kf_end
        bend = se3.log(se3.inverse(T_any_end) @ T_any_kf[ids[ends]])
        between = ends - starts - 1
        span = np.repeat(np.arange(len(starts)), between)
        inner = np.arange(len(span)) - np.repeat(np.cumsum(between) - between, between)
        inner += starts[span] + 1
        first_s, last_s = (frames.timestamps_s[each][span] for each in (starts, ends))
        share = (frames.timestamps_s[inner] - first_s) / (last_s - first_s)
        T_end_cam = se3.inverse(T_kf_end)[span] @ frames.T_kf_cam[inner]
        T_any_cam[inner] = T_any_end[span] @ se3.exp(share[:, None] * bend[span]) @ T_end_cam

    def live(
        self, T_any_kf: FloatArray, T_any_cam: Callable[[LoggedFrames], FloatArray]
    ) -> Trajectory:
        """Return the frames that `trajectory` returns, where they were when they were tracked.

        What is called tells the (N, 4, 4) poses of N frames, NaN where they were not known.
        """
        frames = self._on(np.isfinite(T_any_kf[:, 0, 0]))
        T = T_any_cam(frames)
        is_known = np.isfinite(T[:, 0, 0])
        return Trajectory(frames.timestamps_s[is_known], T[is_known])

    def tracked(self, T_any_kf: FloatArray) -> list[Trajectory]:
        """Return the same per segment, by the poses of keyframes in a frame of each segment's."""
        frames = self._on(np.isfinite(T_any_kf[:, 0, 0]))
        T_any_cam = T_any_kf[frames.keyframe_id] @ frames.T_kf_cam
        of_segment = [frames.segment == each for each in np.unique(frames.segment)]
        return [Trajectory(frames.timestamps_s[some], T_any_cam[some]) for some in of_segment]

    def along(
        self, given: Trajectory, keyframe_s: FloatArray, doubted: Sequence[int]
    ) -> "FrameLog":
        """Return the log with frames placed against their keyframes as another odometry has them.

        That has the given camera poses; the keyframes were taken at (K,) times. On the way to a
        doubted keyframe, and where the odometry has no pose, what was tracked stays.
        """
        T_given_kf = poses_between(given, keyframe_s)
        frames, followed = self.placed, copy(self)
        T_given_cam = poses_between(given, frames.timestamps_s)
        T_before_kf = se3.inverse(T_given_kf[:-1]) @ T_given_kf[1:]
        is_followed = np.isfinite(T_before_kf).all(axis=(1, 2))
        is_followed &= ~np.isin(np.arange(1, len(T_given_kf)), doubted)
        followed._T_ref_kf = self._T_ref_kf | {
            (k + 1, k): T_before_kf[k] for k in np.flatnonzero(is_followed).tolist()
        }
        k = frames.newest_id
        is_here = (frames.keyframe_id == k) & (k < len(T_given_kf))
        is_here &= ~(frames.T_kf_cam == np.eye(4)).all(axis=(1, 2))  # a keyframe is where it is
        is_here &= ~np.isin(k + 1, doubted)
        here = np.flatnonzero(is_here)
        T_kf_cam = se3.inverse(T_given_kf[k[here]]) @ T_given_cam[here]
        is_known = np.isfinite(T_kf_cam).all(axis=(1, 2))
        frames.T_kf_cam[here[is_known]] = T_kf_cam[is_known]
        followed._T_kf_cam = array("d", frames.T_kf_cam.tobytes())
        return followed

    @property
    def placed_s(self) -> FloatArray:
        """(N,) times of the frames that were placed."""
        return np.array(self._timestamps_s)

    def breaks_s(self) -> FloatArray:
        """Return when frames were taken that need not be near the one before.

        They are the first after a lost one, and the first of another segment.
        """
        times_s = self.placed_s
        lost_before = np.searchsorted(self._lost_s, times_s)
        is_break = (np.diff(self._segments) != 0) | (np.diff(lost_before) != 0)
        return np.asarray(times_s[1:][is_break], np.float64)

    def unjoined_s(self, T_any_kf: FloatArray) -> FloatArray:
        """Return when the frames were taken whose keyframe is NaN among (K, 4, 4) poses."""
        return self._on(np.isnan(T_any_kf[:, 0, 0])).timestamps_s

    def untracked_s(self, T_any_kf: FloatArray) -> FloatArray:
        """Return when all frames were taken that (K, 4, 4) poses give no place, in time order."""
        placed_s = self._on(np.isfinite(T_any_kf[:, 0, 0])).timestamps_s
        return np.setdiff1d([*self._lost_s, *self._timestamps_s], placed_s)

    def warnings(self, T_any_kf: FloatArray) -> tuple[str, ...]:
        """Return what is to be said of frames that were lost, not joined, or placed by little."""
        total, warnings = len(self._lost_s) + len(self._timestamps_s), []
        if self._lost_s:
            warnings.append(
                f"{len(self._lost_s)} of {total} frames could not be tracked and are in no"
                f" trajectory; the first at {self._lost_s[0]:.3f} s"
            )
        unjoined_s = self.unjoined_s(T_any_kf)
        if len(unjoined_s):
            placed_s = self._on(np.isfinite(T_any_kf[:, 0, 0])).timestamps_s
            beginning = ""
            if self._newest_before < 0 and placed_s[0] != self._timestamps_s[0]:
                beginning = "; the map is the part with the most frames, which begins at"
                beginning += f" {placed_s[0]:.3f} s"
            warnings.append(
                f"{len(unjoined_s)} of {total} frames, from {unjoined_s[0]:.3f} s to"
                f" {unjoined_s[-1]:.3f} s, were tracked apart from the rest and are in no"
                f" trajectory: no loops at two places agree where they belong{beginning}"
            )
        return (*warnings, *self._dragged())

    def _dragged(self) -> tuple[str, ...]:
        """Return a sentence if the camera may have followed something that moves by itself."""
        covered = np.array(self._covered)
        if len(covered) < _WHILE:
            return ()
        usual = np.median(np.lib.stride_tricks.sliding_window_view(covered, _WHILE), axis=1)
        doubted = np.flatnonzero(usual < _LITTLE)
        if not len(doubted):
            return ()
        frames = np.unique(np.add.outer(doubted, np.arange(_WHILE)))
        start_s, end_s = self.placed_s[frames[[0, -1]]]
        return (
            f"features in only {np.median(covered[frames]):.0%} of the image agree on where"
            f" {len(frames)} frames between {start_s:.3f} s and {end_s:.3f} s were taken: if"
            " something moves before the camera there, the path may be that thing's",
        )

    def _on(self, chosen: NDArray[np.bool_]) -> LoggedFrames:
        """Return the frames whose keyframe is chosen by a (K,) mask; later keyframes are not."""
        frames = self.placed
        return frames.select(np.append(chosen, False)[np.minimum(frames.keyframe_id, len(chosen))])

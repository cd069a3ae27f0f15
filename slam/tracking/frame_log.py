# SPDX-License-Identifier: Apache-2.0
"""Every frame and the keyframe it was placed against: it is corrected when the keyframe is."""

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.external_odometry.given_poses import poses_between
from slam.geometry import se3
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Camera, FloatArray, Frame, SlamError, Trajectory


def check_frame(frame: Frame, camera: Camera, last_s: float) -> None:
    """Refuse a frame that cannot follow on one taken at last_s by this camera.

    Raises:
        SlamError: the frame is not of the camera's size, or the time does not increase.
    """
    if not last_s < frame.timestamp_s < np.inf:
        raise SlamError(
            f"frames must come in the order of time: {frame.timestamp_s:.6f} s after {last_s:.6f} s"
        )
    wanted = (camera.height, camera.width)
    if frame.rgb.dtype != np.uint8:
        raise SlamError(
            f"the frame at {frame.timestamp_s:.6f} s has {frame.rgb.dtype} colours, not uint8"
        )
    if frame.rgb.shape != (*wanted, 3) or frame.depth_m.shape != wanted:
        raise SlamError(
            f"the frame at {frame.timestamp_s:.6f} s has colour {frame.rgb.shape} and depth"
            f" {frame.depth_m.shape}, but the camera makes {(*wanted, 3)} and {wanted}"
        )


# Where for so many frames only features in so little of the image agree, those in the rest of it
# may be the ones that stand still.
_WHILE, _LITTLE = 15, 0.5


class LoggedFrame(NamedTuple):
    """A frame that was placed against a keyframe.

    Attributes:
        timestamp_s: seconds.
        keyframe_id: the keyframe, itself where it became one.
        T_kf_cam: (4, 4), in the keyframe's camera frame.
        segment: the keyframe's.
        T_odom_cam: (4, 4), as it was known when the frame was tracked.
        newest_id: the newest keyframe then.
        T_ref_cam: (4, 4) motions of a new keyframe by the id of the other one.
        covered: in which share of the image features agree on where it was taken.
    """

    timestamp_s: float
    keyframe_id: int
    T_kf_cam: FloatArray
    segment: int
    T_odom_cam: FloatArray
    newest_id: int
    T_ref_cam: dict[int, FloatArray]
    covered: float = 1.0


def _shared_bend(frames: Sequence[LoggedFrame], T_any_kf: FloatArray) -> FloatArray | None:
    """Return (N - 2, 4, 4), the frames after a keyframe, bent towards the last, the next one.

    None where there is no bend to share: frames in between were placed against another keyframe, or
    no link says how the odometry came from the one to the other.
    """
    start, end = frames[0], frames[-1]
    T_kf_end = end.T_ref_cam.get(start.keyframe_id)
    if T_kf_end is None or {each.keyframe_id for each in frames[:-1]} != {start.keyframe_id}:
        return None
    T_any_end = T_any_kf[start.keyframe_id] @ T_kf_end
    bend = se3.log(se3.inverse(T_any_end) @ T_any_kf[end.keyframe_id])
    times_s = np.array([each.timestamp_s for each in frames])
    share = (times_s - times_s[0]) / (times_s[-1] - times_s[0])
    T_end_cam = se3.inverse(T_kf_end) @ np.array([each.T_kf_cam for each in frames[1:-1]])
    return np.asarray(T_any_end @ se3.exp(share[1:-1, None] * bend) @ T_end_cam)


def _along(
    frame: LoggedFrame, T_given_cam: FloatArray, T_given_kf: FloatArray, doubted: Sequence[int]
) -> LoggedFrame:
    """Return a frame placed as an odometry has it that has keyframes at (K, 4, 4) poses."""
    k = frame.newest_id
    if frame.keyframe_id != k or k >= len(T_given_kf):
        return frame
    is_keyframe = np.array_equal(frame.T_kf_cam, np.eye(4))
    if is_keyframe and k and k not in doubted:
        T_before_kf = se3.inverse(T_given_kf[k - 1]) @ T_given_kf[k]
        if np.isfinite(T_before_kf).all():
            return frame._replace(T_ref_cam={**frame.T_ref_cam, k - 1: T_before_kf})
    T_kf_cam = se3.inverse(T_given_kf[k]) @ T_given_cam
    if is_keyframe or k + 1 in doubted or not np.isfinite(T_kf_cam).all():
        return frame
    return frame._replace(T_kf_cam=T_kf_cam)


class FrameLog:
    """Every frame of a run: placed against a keyframe, or lost."""

    def __init__(self) -> None:
        self._frames: list[LoggedFrame] = []
        self._lost_s: list[float] = []

    def add(self, timestamp_s: float, tracked: TrackedFrame) -> None:
        """Remember a frame by its place in a keyframe's camera frame, and by where it was then."""
        newest_id = self._frames[-1].newest_id if self._frames else -1
        if tracked.new_keyframe:
            newest_id = tracked.new_keyframe.id
        self._frames.append(
            LoggedFrame(
                timestamp_s,
                tracked.keyframe_id,
                tracked.T_kf_cam,
                tracked.segment,
                tracked.T_odom_cam,
                newest_id,
                {link.ref_id: link.motion.T_ref_query for link in tracked.links},
                tracked.covered,
            )
        )

    @property
    def segment(self) -> int | None:
        """The segment of the last frame that was placed, None before there is one."""
        return self._frames[-1].segment if self._frames else None

    def lose(self, timestamp_s: float) -> None:
        """Remember a frame that could not be placed."""
        self._lost_s.append(timestamp_s)

    def per_keyframe(self) -> Counter[int]:
        """Return how many frames were placed against each keyframe id."""
        return Counter(frame.keyframe_id for frame in self._frames)

    def trajectory(self, T_any_kf: FloatArray) -> Trajectory:
        """Return the frames whose keyframe is among (K, 4, 4) poses and not NaN there.

        Where the poses bend the motion from one keyframe to the next, the frames between them share
        the bend in proportion to time.
        """
        frames = self._on(np.isfinite(T_any_kf[:, 0, 0]))
        T_any_cam = np.array([T_any_kf[each.keyframe_id] @ each.T_kf_cam for each in frames])
        ends = [n for n, each in enumerate(frames) if n and each.newest_id == each.keyframe_id]
        ends = [n for n in ends if frames[n - 1].newest_id != frames[n].newest_id]
        for start, end in pairwise([0, *ends]):
            if end - start < 2:
                continue
            bent = _shared_bend(frames[start : end + 1], T_any_kf)
            if bent is not None:
                T_any_cam[start + 1 : end] = bent
        return Trajectory(np.array([frame.timestamp_s for frame in frames]), T_any_cam)

    def live(
        self, T_any_kf: FloatArray, T_any_cam: Callable[[LoggedFrame], FloatArray | None]
    ) -> Trajectory:
        """Return the frames that `trajectory` returns, where they were when they were tracked.

        What is called tells the (4, 4) pose of a frame, None where it was not known.
        """
        frames = self._on(np.isfinite(T_any_kf[:, 0, 0]))
        known = [(each.timestamp_s, T) for each in frames if (T := T_any_cam(each)) is not None]
        return Trajectory(
            timestamps_s=np.array([timestamp_s for timestamp_s, _ in known]),
            T_world_cam=np.array([T for _, T in known]).reshape(-1, 4, 4),
        )

    def tracked(self, T_any_kf: FloatArray) -> list[Trajectory]:
        """Return the same per segment, by the poses of keyframes in a frame of each segment's."""
        frames = self._on(np.isfinite(T_any_kf[:, 0, 0]))
        segments = sorted({each.segment for each in frames})
        of_segment = [[each for each in frames if each.segment == s] for s in segments]
        return [
            Trajectory(
                np.array([each.timestamp_s for each in some]),
                np.array([T_any_kf[each.keyframe_id] @ each.T_kf_cam for each in some]),
            )
            for some in of_segment
        ]

    def along(
        self, given: Trajectory, keyframe_s: FloatArray, doubted: Sequence[int]
    ) -> "FrameLog":
        """Return the log with frames placed against their keyframes as another odometry has them.

        That has the given camera poses; the keyframes were taken at (K,) times. On the way to a
        doubted keyframe, and where the odometry has no pose, what was tracked stays.
        """
        T_kf = poses_between(given, keyframe_s)
        T_given_cam = poses_between(given, self.placed_s)
        followed = FrameLog()
        followed._lost_s = self._lost_s
        followed._frames = [
            _along(frame, T, T_kf, doubted)
            for frame, T in zip(self._frames, T_given_cam, strict=True)
        ]
        return followed

    @property
    def placed_s(self) -> FloatArray:
        """(N,) times of the frames that were placed."""
        return np.array([frame.timestamp_s for frame in self._frames])

    def breaks_s(self) -> FloatArray:
        """Return when frames were taken that need not be near the one before.

        They are the first after a lost one, and the first of another segment.
        """
        times_s = np.array([frame.timestamp_s for frame in self._frames])
        segments = np.array([frame.segment for frame in self._frames], dtype=np.int64)
        lost_before = np.searchsorted(self._lost_s, times_s)
        is_break = (np.diff(segments) != 0) | (np.diff(lost_before) != 0)
        return np.asarray(times_s[1:][is_break], np.float64)

    def unjoined_s(self, T_any_kf: FloatArray) -> FloatArray:
        """Return when the frames were taken whose keyframe is NaN among (K, 4, 4) poses."""
        return np.array([frame.timestamp_s for frame in self._on(np.isnan(T_any_kf[:, 0, 0]))])

    def untracked_s(self, T_any_kf: FloatArray) -> FloatArray:
        """Return when all frames were taken that (K, 4, 4) poses give no place, in time order."""
        every_s = [*self._lost_s, *(frame.timestamp_s for frame in self._frames)]
        placed = self._on(np.isfinite(T_any_kf[:, 0, 0]))
        return np.setdiff1d(every_s, [frame.timestamp_s for frame in placed])

    def warnings(self, T_any_kf: FloatArray) -> tuple[str, ...]:
        """Return what is to be said of frames that were lost, not joined, or placed by little."""
        total, warnings = len(self._lost_s) + len(self._frames), []
        if self._lost_s:
            warnings.append(
                f"{len(self._lost_s)} of {total} frames could not be tracked and are in no"
                f" trajectory; the first at {self._lost_s[0]:.3f} s"
            )
        unjoined_s = self.unjoined_s(T_any_kf)
        if len(unjoined_s):
            placed = self._on(np.isfinite(T_any_kf[:, 0, 0]))
            start_s, beginning = placed[0].timestamp_s, ""
            if start_s != self._frames[0].timestamp_s:
                beginning = (
                    f"; the map is the part with the most frames, which begins at {start_s:.3f} s"
                )
            warnings.append(
                f"{len(unjoined_s)} of {total} frames, from {unjoined_s[0]:.3f} s to"
                f" {unjoined_s[-1]:.3f} s, were tracked apart from the rest and are in no"
                f" trajectory: no loops at two places agree where they belong{beginning}"
            )
        return (*warnings, *self._dragged())

    def _dragged(self) -> tuple[str, ...]:
        """Return a sentence if the camera may have followed something that moves by itself."""
        covered = np.array([frame.covered for frame in self._frames])
        if len(covered) < _WHILE:
            return ()
        usual = np.median(np.lib.stride_tricks.sliding_window_view(covered, _WHILE), axis=1)
        doubted = np.flatnonzero(usual < _LITTLE)
        if not len(doubted):
            return ()
        frames = np.unique(np.add.outer(doubted, np.arange(_WHILE)))
        start_s, end_s = (self._frames[n].timestamp_s for n in frames[[0, -1]])
        return (
            f"features in only {np.median(covered[frames]):.0%} of the image agree on where"
            f" {len(frames)} frames between {start_s:.3f} s and {end_s:.3f} s were taken: if"
            " something moves before the camera there, the path may be that thing's",
        )

    def _on(self, chosen: NDArray[np.bool_]) -> list[LoggedFrame]:
        """Return the frames whose keyframe is chosen by a (K,) mask; later keyframes are not."""
        return [f for f in self._frames if f.keyframe_id < len(chosen) and chosen[f.keyframe_id]]

# SPDX-License-Identifier: Apache-2.0
"""Where the frames of a run were when they came: as they were tracked, and corrected until then."""

from collections.abc import Mapping, Sequence

import numpy as np

from slam.loops.correction import Correction
from slam.tracking.frame_log import FrameLog, LoggedFrames
from slam.types import FloatArray, Trajectory


def tracked(
    frames: FrameLog, T_world_kf: FloatArray, T_odom_segment: Mapping[int, FloatArray]
) -> Trajectory:
    """Return where frames were tracked, with (4, 4) T_odom_segment by segment to have all in one.

    They are those whose keyframe has a place among (K, 4, 4) poses.
    """
    return frames.live(T_world_kf, lambda some: _in_one_frame(some, T_odom_segment))


def live(
    frames: FrameLog,
    T_world_kf: FloatArray,
    corrections: Sequence[Correction],
    T_given_cam: Mapping[float, FloatArray],
) -> Trajectory:
    """Return where the same frames were thought to be, in the world, by the corrections until then.

    Where an odometry from elsewhere was corrected, its (4, 4) poses by time were, else tracking.
    """
    newest_ids = np.array([each.newest_id for each in corrections])

    def T_world_cam(some: LoggedFrames) -> FloatArray:
        T = np.full((len(some.timestamps_s), 4, 4), np.nan)
        known = np.searchsorted(newest_ids, some.newest_id, side="right") - 1
        for number in np.unique(known):
            now = known == number
            T[now] = _corrected(some.select(now), corrections[number], T_given_cam)
        return T

    return frames.live(T_world_kf, T_world_cam)


def _corrected(
    frames: LoggedFrames, correction: Correction, T_given_cam: Mapping[float, FloatArray]
) -> FloatArray:
    """Return the (N, 4, 4) poses of frames in the world, NaN where nothing tells."""
    T = _in_one_frame(frames, correction.T_world_odom)
    if correction.T_world_given is None:
        return T
    for n, timestamp_s in enumerate(frames.timestamps_s.tolist()):
        if (T_odom_cam := T_given_cam.get(timestamp_s)) is not None:
            T[n] = correction.T_world_given @ T_odom_cam
    return T


def _in_one_frame(frames: LoggedFrames, T_any_odom: Mapping[int, FloatArray]) -> FloatArray:
    """Return the (N, 4, 4) poses of frames as tracked, NaN for segments that are not known."""
    T = np.full((len(frames.timestamps_s), 4, 4), np.nan)
    for segment, T_any_segment in T_any_odom.items():
        some = frames.segment == segment
        T[some] = T_any_segment @ frames.T_odom_cam[some]
    return T

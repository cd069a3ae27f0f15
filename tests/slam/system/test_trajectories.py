# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.loops.correction import Correction
from slam.system import trajectories
from slam.tracking.frame_log import FrameLog
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Keyframe


def at(place):
    T = np.eye(4)
    T[0, 3] = place
    return T


@pytest.fixture
def frames():
    """Return a frame, one second and one metre after the other, on each of four keyframes.

    The last two are of another segment.
    """
    frames = FrameLog()
    for k in range(4):
        keyframe = Keyframe(k, float(k), at(k), None, None, segment=k // 2)
        frames.add(float(k), TrackedFrame(k, np.eye(4), at(k), k // 2, new_keyframe=keyframe))
    return frames


def places(trajectory):
    return dict(
        zip(
            trajectory.timestamps_s.tolist(),
            trajectory.T_world_cam[:, 0, 3].tolist(),
            strict=True,
        )
    )


T_WORLD_KF = np.array([at(k) for k in range(4)])


def test_frames_as_tracked_are_in_one_frame_where_their_segments_are(frames):
    tracked = trajectories.tracked(frames, T_WORLD_KF, {0: at(0.0), 1: at(100.0)})
    assert places(tracked) == {0.0: 0.0, 1.0: 1.0, 2.0: 102.0, 3.0: 103.0}


def test_frames_whose_keyframe_has_no_place_are_in_neither(frames):
    T_world_kf = T_WORLD_KF.copy()
    T_world_kf[1] = np.nan
    begin = Correction(0, -1, {}, {0: at(0.0), 1: at(0.0)})
    for found in (
        trajectories.tracked(frames, T_world_kf, {0: at(0.0), 1: at(0.0)}),
        trajectories.live(frames, T_world_kf, [begin], {}),
    ):
        assert list(places(found)) == [0.0, 2.0, 3.0]


def test_each_frame_is_live_by_the_newest_correction_that_knew_no_later_keyframe(frames):
    corrections = [
        Correction(0, -1, {}, {0: at(10.0)}),  # nothing tells yet where the other segment lies
        Correction(1, 1, {}, {0: at(20.0)}),
        Correction(2, 3, {}, {0: at(30.0), 1: at(40.0)}),
    ]
    live = trajectories.live(frames, T_WORLD_KF, corrections, {})
    assert places(live) == {0.0: 10.0, 1.0: 21.0, 3.0: 43.0}


def test_an_odometry_from_elsewhere_is_followed_live_as_far_as_it_is_corrected(frames):
    corrections = [
        Correction(0, -1, {}, {0: at(10.0)}, T_world_given=at(1000.0)),
        Correction(1, 2, {}, {0: at(20.0), 1: at(30.0)}),
    ]
    T_given_cam = {0.0: at(0.5), 2.0: at(2.5), 3.0: at(3.5)}
    live = trajectories.live(frames, T_WORLD_KF, corrections, T_given_cam)
    # It has no pose of the second frame; from the third on the images contradict it.
    assert places(live) == {0.0: 1000.5, 1.0: 11.0, 2.0: 32.0, 3.0: 33.0}

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.tracking.frame_log import FrameLog
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Keyframe, Link, RelativePose, Trajectory

AHEAD = np.eye(4)
AHEAD[0, 3] = 0.5


def link(ref_id, query_id):
    """Return the motion of a metre ahead."""
    return Link(ref_id, query_id, RelativePose(AHEAD @ AHEAD, np.eye(6)))


@pytest.fixture
def frames():
    """Return two frames on each of keyframes 0, 1 and 2, and two that were lost in between."""
    frames = FrameLog()
    for k in range(3):
        (T_odom_cam,) = poses(100.0 + k)
        here = TrackedFrame(k, np.eye(4), T_odom_cam, k // 2)
        tie = (link(0, 1),) if k == 1 else ()
        keyframe = Keyframe(k, 10.0 * k, T_odom_cam, None, None, segment=k // 2)
        frames.add(10.0 * k, replace(here, new_keyframe=keyframe, links=tie))
        frames.add(10.0 * k + 1.0, replace(here, T_kf_cam=AHEAD, T_odom_cam=T_odom_cam @ AHEAD))
        frames.lose(10.0 * k + 2.0)
    return frames


def poses(*places):
    T = np.tile(np.eye(4), (len(places), 1, 1))
    T[:, 0, 3] = places
    T[np.isnan(places)] = np.nan
    return T


def test_frames_move_with_their_keyframe_and_share_the_bend_to_the_next_one(frames):
    trajectory = frames.trajectory(poses(0.0, 4.0, 7.0))
    assert trajectory.timestamps_s.tolist() == [0.0, 1.0, 10.0, 11.0, 20.0, 21.0]
    # From the first keyframe to the second the odometry went 1 m, not 4; a tenth of the way of it
    # had passed. The third keyframe is of another segment.
    expected = [0.0, 0.8, 4.0, 4.5, 7.0, 7.5]
    np.testing.assert_allclose(trajectory.T_world_cam[:, 0, 3], expected, atol=1e-12)
    assert frames.per_keyframe() == {0: 2, 1: 2, 2: 2}


def walk(*steps):
    """Return the log of steps (keyframe, metres ahead of it, ids that it is a keyframe linked to).

    A second passes in each. Where the odometry had them at the time says nothing.
    """
    frames = FrameLog()
    for second, (k, ahead_m, linked_ids) in enumerate(steps):
        tracked = TrackedFrame(k, poses(ahead_m)[0], np.eye(4))
        if linked_ids is not None:
            keyframe = Keyframe(k, float(second), np.eye(4), None, None)
            links = tuple(link(ref_id, k) for ref_id in linked_ids)
            tracked = replace(tracked, new_keyframe=keyframe, links=links)
        frames.add(float(second), tracked)
    return frames


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([(0, 0.0, ()), (0, 0.5, None), (1, 0.0, [0])], [0.0, 2.0, 4.0]),
        # It was recognized at another keyframe in between.
        (
            [(0, 0.0, ()), (1, 0.0, [0]), (0, 0.5, None), (1, 0.5, None), (2, 0.0, [0, 1])],
            [0.0, 4.0, 0.5, 4.5, 9.0],
        ),
        # It was lost, and a keyframe was made where it was found: far from where it had been.
        (
            [(0, 0.0, ()), (1, 0.0, [0]), (1, 0.5, None), (2, 0.0, [0])],
            [0.0, 4.0, 4.5, 9.0],
        ),
    ],
    ids=["followed", "elsewhere in between", "found elsewhere"],
)
def test_only_a_camera_that_was_followed_to_the_next_keyframe_shares_its_bend(steps, expected):
    trajectory = walk(*steps).trajectory(poses(0.0, 4.0, 9.0))
    np.testing.assert_allclose(trajectory.T_world_cam[:, 0, 3], expected, atol=1e-12)


def test_a_map_that_moves_as_a_whole_is_no_bend():
    T_world_kf = poses(0.03, 1.03)
    trajectory = walk((0, 0.0, ()), (0, 0.2, None), (1, 0.0, [0])).trajectory(T_world_kf)
    np.testing.assert_allclose(trajectory.T_world_cam[:, 0, 3], [0.03, 0.23, 1.03], atol=1e-12)


def test_live_frames_stay_where_they_were_when_they_were_tracked(frames):
    asked = []

    def corrected(frames):
        asked.extend(zip(frames.segment.tolist(), frames.newest_id.tolist(), strict=True))
        T = poses(1000.0)[0] @ frames.T_odom_cam
        T[frames.segment != 0] = np.nan
        return T

    live = frames.live(poses(0.0, 4.0, 7.0), corrected)
    assert live.timestamps_s.tolist() == [0.0, 1.0, 10.0, 11.0]
    assert live.T_world_cam[:, 0, 3].tolist() == [1100.0, 1100.5, 1101.0, 1101.5]
    assert asked == [(0, 0), (0, 0), (0, 1), (0, 1), (1, 2), (1, 2)]
    assert frames.segment == 1 and FrameLog().segment is None
    nowhere = frames.live(
        poses(np.nan, np.nan, 7.0), lambda frames: np.full_like(frames.T_odom_cam, np.nan)
    )
    assert nowhere.T_world_cam.shape == (0, 4, 4)


def test_frames_of_a_keyframe_without_a_place_have_none_either(frames):
    T_world_kf = poses(0.0, np.nan, 7.0)
    assert frames.trajectory(T_world_kf).timestamps_s.tolist() == [0.0, 1.0, 20.0, 21.0]
    assert frames.unjoined_s(T_world_kf).tolist() == [10.0, 11.0]
    assert frames.untracked_s(T_world_kf).tolist() == [2.0, 10.0, 11.0, 12.0, 22.0]


def test_keyframes_that_nobody_knows_take_their_frames_with_them(frames):
    assert len(frames.trajectory(poses(0.0, 4.0))) == 4
    assert len(frames.unjoined_s(poses(0.0, 4.0))) == 0
    assert frames.untracked_s(poses(0.0, 4.0)).tolist() == [2.0, 12.0, 20.0, 21.0, 22.0]


def test_a_path_breaks_where_the_camera_was_lost_or_another_segment_begins(frames):
    assert frames.breaks_s().tolist() == [10.0, 20.0]
    unbroken = FrameLog()
    for k, segment in enumerate((0, 0, 1, 1, 0)):
        unbroken.add(float(k), TrackedFrame(k, np.eye(4), np.eye(4), segment))
    assert unbroken.breaks_s().tolist() == [2.0, 4.0]
    unbroken.lose(2.5)
    assert unbroken.breaks_s().tolist() == [2.0, 3.0, 4.0]
    assert len(FrameLog().breaks_s()) == 0


def test_a_session_starts_with_the_frame_that_comes_next_whatever_becomes_of_it():
    log = FrameLog()
    log.start_session()  # the first may be announced too
    for timestamp_s in (1.0, 2.0, 3.0):
        log.expect(timestamp_s)
        log.start_session()
    log.start_session()  # of one that nothing came of nobody knows
    log.expect(4.0)
    log.expect(5.0)
    assert log.session_starts_s == [2.0, 3.0, 4.0] and log.last_s == 5.0


def test_frames_of_an_earlier_map_count_as_placed_and_are_in_no_trajectory():
    log = FrameLog([3, 0, 2])
    log.add(9.0, TrackedFrame(2, np.eye(4), np.eye(4)))
    assert log.per_keyframe() == {0: 3, 2: 3}
    assert log.trajectory(poses(0.0, 1.0, 2.0)).timestamps_s.tolist() == [9.0]
    assert log.placed.newest_id.tolist() == [2]


def test_lost_frames_and_those_apart_are_warned_of(frames):
    lost, apart = frames.warnings(poses(0.0, np.nan, 7.0))
    assert lost.startswith("3 of 9 frames could not be tracked") and lost.endswith("2.000 s")
    assert apart.startswith("2 of 9 frames, from 10.000 s to 11.000 s, were tracked apart")
    assert apart.endswith("where they belong")
    assert frames.warnings(poses(0.0, 4.0, 7.0)) == (lost,)
    _, first = frames.warnings(poses(np.nan, np.nan, 7.0))
    assert first.startswith("4 of 9 frames") and first.endswith("begins at 20.000 s")
    assert FrameLog().warnings(poses()) == ()


@pytest.mark.parametrize(
    ("covered", "said"),
    [
        (40 * [0.8], None),
        (14 * [0.3], None),
        ([*20 * [0.9], *7 * [0.3], *20 * [0.9]], None),
        ([*20 * [0.9], *30 * [0.3], *20 * [0.9]], "only 30% of the image"),
        (15 * [0.3], "15 frames between 0.000 s and 14.000 s"),
    ],
    ids=["all of it", "too few", "for a moment", "for a while", "from the start"],
)
def test_frames_that_little_of_the_image_agrees_on_are_warned_of(covered, said):
    log = FrameLog()
    for second, share in enumerate(covered):
        log.add(float(second), TrackedFrame(0, np.eye(4), np.eye(4), covered=share))
    warnings = log.warnings(poses(0.0))
    assert len(warnings) == (said is not None)
    assert all(said in each and "something moves before the camera" in each for each in warnings)


def test_frames_follow_another_odometry_but_where_it_is_doubted():
    T_kf = poses(0.0, 1.0, 2.0)
    log = walk((0, 0.0, ()), (0, 0.2, None), (1, 0.0, [0]), (1, 0.2, None), (2, 0.0, [1]))
    times_s = log.placed_s
    keyframe_s = times_s[[0, 2, 4]]
    given = Trajectory(times_s, poses(0.0, 0.5, 1.0, 1.5, 2.0))
    followed = log.along(given, keyframe_s, doubted=[]).trajectory(T_kf)
    np.testing.assert_allclose(followed.T_world_cam[:, 0, 3], [0.0, 0.5, 1.0, 1.5, 2.0])
    doubted = log.along(given, keyframe_s, doubted=[2]).trajectory(T_kf)
    expected = [0.0, 0.5, 1.0, *log.trajectory(T_kf).T_world_cam[3:, 0, 3]]
    np.testing.assert_allclose(doubted.T_world_cam[:, 0, 3], expected)
    assert expected[3] != 1.5


def test_what_was_tracked_of_a_segment_is_in_a_frame_of_its_own(frames):
    first, second = frames.tracked(poses(0.0, 4.0, 7.0))
    assert first.timestamps_s.tolist() == [0.0, 1.0, 10.0, 11.0]
    assert second.timestamps_s.tolist() == [20.0, 21.0]

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.config import OdometryConfig
from slam.external_odometry.conventions import Convention
from slam.external_odometry.odometry import ExternalOdometry, carried
from slam.external_odometry.trust import Trust, Verdict
from slam.geometry import se3
from slam.types import Link, RelativePose, SlamError, Trajectory

SPEED = np.array([0.1, -0.4, 0.3, 0.5, -0.2, 0.7])  # rad/s, m/s
NOTHING = np.zeros(3)


def steady(stamps_s):
    stamps_s = np.asarray(stamps_s, dtype=np.float64)
    return Trajectory(stamps_s, se3.exp(stamps_s[:, None] * SPEED))


def ahead(*metres):
    T = np.tile(np.eye(4), (len(metres), 1, 1))
    T[:, 0, 3] = metres
    return T


def filled(trajectory, config=None, covariance=None):
    external = ExternalOdometry(config or OdometryConfig())
    for time_s, T in zip(trajectory.timestamps_s.tolist(), trajectory.T_world_cam, strict=True):
        external.add(time_s, T, covariance)
    return external


def refusal(T=None, covariance=None, time_s=2.0):
    external = filled(steady([0.0, 1.0]))
    with pytest.raises(SlamError) as error:
        external.add(time_s, np.eye(4) if T is None else T, covariance)
    assert "\n" not in str(error.value)
    external.add(2.0, np.eye(4), np.eye(6))  # it goes on as if nothing had come
    return str(error.value)


SHEARED, MIRRORED, UNFINISHED, LAST_ROW = (np.eye(4) for _ in range(4))
SHEARED[0, 1], MIRRORED[2, 2], UNFINISHED[0, 3], LAST_ROW[3, 0] = 0.01, -1.0, np.nan, 0.1


@pytest.mark.parametrize(
    "T",
    [SHEARED, MIRRORED, UNFINISHED, LAST_ROW, 1.01 * np.eye(4), np.eye(3), np.eye(4)[None]],
    ids=["sheared", "mirrored", "not finite", "last row", "enlarged", "3 x 3", "a stack"],
)
def test_what_is_no_rigid_pose_is_refused_with_its_time(T):
    message = refusal(T)
    assert "2.000000 s" in message and "not a rigid (4, 4) transform" in message


@pytest.mark.parametrize("time_s", [1.0, 0.5, np.nan, np.inf])
def test_poses_must_come_in_the_order_of_time(time_s):
    assert "in the order of time" in refusal(time_s=time_s)


UNKNOWN = np.eye(6)
UNKNOWN[3, 3] = np.nan


@pytest.mark.parametrize(
    "covariance",
    [UNKNOWN, np.zeros((6, 6)), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0]), np.eye(3)],
    ids=["not finite", "zero", "negative", "3 x 3"],
)
def test_what_is_no_covariance_is_refused_with_its_time(covariance):
    message = refusal(covariance=covariance)
    assert "the covariance of the pose at 2.000000 s" in message


def test_it_is_true_once_there_is_a_pose_and_keeps_a_copy():
    external = ExternalOdometry(OdometryConfig())
    assert not external
    T, covariance = ahead(1.0)[0], np.eye(6)
    external.add(0.0, T, covariance)
    external.add(1.0, T, covariance)
    T[0, 3], covariance[0, 0] = 9.0, 9.0
    assert external
    np.testing.assert_array_equal(external.camera_poses.T_world_cam, ahead(1.0, 1.0))
    told = external.next_keyframe(1.0, ahead(1.0)[0])
    np.testing.assert_array_equal(told.covariance, 2.0 * np.eye(6))


def test_a_pose_comes_back_as_the_cameras(T_base_cam):
    tx, ty, tz = T_base_cam[:3, 3]
    mount = (tx, ty, tz, *se3.to_quaternion(T_base_cam[:3, :3]).tolist())
    config = OdometryConfig(T_base_cam=mount, scale=0.5, time_offset_s=0.2)
    external = ExternalOdometry(config)
    assert external.time_offset_s == 0.2
    found = external.add(3.2, ahead(4.0)[0], None)
    np.testing.assert_allclose(found, ahead(2.0)[0] @ T_base_cam, atol=1e-12)
    assert external.camera_poses.timestamps_s == pytest.approx([3.0])


@pytest.mark.parametrize("time_s", [0.1, 0.13, 0.2, 0.22, 0.249])
def test_about_the_last_pose_the_camera_moves_steadily(time_s):
    external = filled(steady([0.0, 0.1, 0.2]))
    np.testing.assert_allclose(external.at(time_s), steady([time_s]).T_world_cam[0], atol=1e-12)


@pytest.mark.parametrize("time_s", [0.0, 0.05, 0.1, 0.19])
def test_poses_may_come_long_before_the_image_of_their_time(time_s):
    external = filled(steady(np.arange(50) / 10))
    np.testing.assert_allclose(external.at(time_s), steady([time_s]).T_world_cam[0], atol=1e-12)


def test_a_keyframe_is_told_whether_the_pose_is_of_its_time_or_between_two():
    external = filled(steady([0.2, 0.3, 0.4]), OdometryConfig(time_offset_s=0.2))
    found = [external.next_keyframe(t, external.at(t)) for t in (0.0, 0.05, 0.1)]
    assert [each.is_between for each in found] == [False, True, False]


@pytest.mark.parametrize("time_s", [-0.05, 0.251, 0.5])
def test_further_than_50_ms_ahead_or_before_the_first_nothing_is_known(time_s):
    assert filled(steady([0.0, 0.1, 0.2])).at(time_s) is None


def test_it_looks_ahead_no_further_than_the_last_step_was_long():
    external = filled(steady([0.0, 0.02]))
    assert external.at(0.039) is not None
    assert external.at(0.045) is None


def test_of_one_pose_no_motion_is_known():
    assert ExternalOdometry(OdometryConfig()).at(0.0) is None
    assert filled(steady([0.0])).at(0.0) is None


def test_what_is_asked_for_by_the_images_clock_is_found_by_the_odometrys():
    external = filled(steady([0.2, 0.3, 0.4]), OdometryConfig(time_offset_s=0.2))
    np.testing.assert_allclose(external.at(0.15), steady([0.35]).T_world_cam[0], atol=1e-12)
    assert external.at(0.35) is None


def test_a_keyframe_is_told_what_came_since_the_one_before():
    external = filled(steady(np.arange(11) / 10), covariance=np.eye(6))
    assert external.next_keyframe(0.1, None) is None
    T = steady([0.2, 0.5]).T_world_cam
    first = external.next_keyframe(0.2, T[0])
    second = external.next_keyframe(0.5, T[1])
    np.testing.assert_array_equal(second.T_given_cam, T[1])
    np.testing.assert_array_equal(first.covariance, 3.0 * np.eye(6))
    np.testing.assert_array_equal(second.covariance, 3.0 * np.eye(6))
    assert not first.is_new and not second.is_new


@pytest.mark.parametrize("first_keyframe_s", [10.0, 10.1])
def test_another_session_begins_anew_at_its_first_keyframe_alone(first_keyframe_s):
    external = ExternalOdometry(OdometryConfig())
    external.start_session()  # nothing came before the first
    external.add(0.0, np.eye(4), None)
    assert not external.next_keyframe(0.0, np.eye(4)).is_new
    external.start_session()
    external.add(10.0, np.eye(4), None)
    external.add(10.1, np.eye(4), None)
    assert external.next_keyframe(first_keyframe_s, np.eye(4)).is_new
    external.add(10.2, np.eye(4), None)
    assert not external.next_keyframe(10.2, np.eye(4)).is_new


@pytest.fixture(scope="module")
def tracked(walk_at, drifting):
    return drifting(walk_at(np.arange(100) / 10.0))


@pytest.fixture(scope="module")
def of_a_body(tracked, walk_at, T_base_cam):
    """Return a body's poses, in units of half a metre and too late, read by images: from 3 s on."""
    given = Convention(T_base_cam, 0.5, 0.15).as_given(walk_at(np.arange(90, 330) / 30.0))
    config = OdometryConfig(T_base_cam="auto", scale="auto", time_offset_s="auto")
    external = filled(given, config, covariance=np.eye(6))
    keyframe_s = np.arange(1.0, 10.0)
    return external, external.read([tracked], keyframe_s), given


def test_keyframes_are_where_the_poses_have_them_as_they_are_read_in_the_end(of_a_body, walk_at):
    external, keyframes, _ = of_a_body
    assert sorted(keyframes) == [2, 3, 4, 5, 6, 7, 8]
    found = np.array([keyframes[k].T_given_cam for k in range(2, 9)])
    off = se3.inverse(found) @ walk_at(np.arange(3.0, 10.0)).T_world_cam
    assert np.degrees(se3.rotation_angle(off)).max() < 1.0
    assert se3.translation_norm(off).max() < 0.03
    for k in range(3, 9):  # 30 poses in a second
        assert keyframes[k].covariance[0, 0] == pytest.approx(30.0, abs=1.0)
    assert np.abs(external.camera_poses.timestamps_s[0] - 3.0) < 0.01


def test_the_poses_before_are_those_of_tracked_frames_that_are_known(of_a_body, tracked, walk_at):
    before = of_a_body[0].before(tracked)
    expected = tracked.timestamps_s[tracked.timestamps_s > 3.01]
    assert np.isin(expected, before.timestamps_s).all() and before.timestamps_s[0] > 2.9
    off = se3.inverse(before.T_world_cam) @ walk_at(before.timestamps_s).T_world_cam
    assert se3.translation_norm(off).max() < 0.03


def test_what_was_known_during_the_run_was_read_as_was_asked_for(of_a_body, walk_at, T_base_cam):
    external, _, given = of_a_body
    stamps_s = np.array([0.0, *given.timestamps_s[[5, 6]]])
    known = external.poses_as_asked(stamps_s)
    assert sorted(known) == stamps_s[1:].tolist()
    np.testing.assert_allclose(known[stamps_s[1]], given.T_world_cam[5], atol=1e-12)
    assert ExternalOdometry(OdometryConfig()).poses_as_asked(stamps_s) == {}


def test_corrected_poses_are_of_the_body_in_its_unit_at_its_times(of_a_body, walk_at, T_base_cam):
    external, _, given = of_a_body
    frames = walk_at(np.arange(30, 140) / 10.0)  # the truth, in a frame of its own
    elsewhere = se3.exp(np.array([0.5, -0.2, 1.0, 3.0, 2.0, -1.0]))
    found = external.corrected(
        Trajectory(frames.timestamps_s, elsewhere @ frames.T_world_cam), None, ()
    )
    np.testing.assert_array_equal(found.given.T_world_cam, given.T_world_cam)
    np.testing.assert_array_equal(found.corrected.timestamps_s, given.timestamps_s)
    np.testing.assert_allclose(found.corrected.T_world_cam[0], given.T_world_cam[0], atol=1e-9)
    off = se3.inverse(found.corrected.T_world_cam) @ given.T_world_cam
    assert 0.5 * se3.translation_norm(off).max() < 0.03
    assert (found.verdict, found.fits) == ("", True)
    assert [each.split("--")[1].split()[0] for each in found.warnings] == [
        "odometry.T-base-cam",
        "odometry.time-offset-s",
        "odometry.scale",
    ]


def test_what_takes_the_odometrys_poses_to_the_corrected_ones_is_in_metres():
    config = OdometryConfig(scale=0.5)
    external = filled(Trajectory(np.arange(5.0), ahead(0.0, 2.0, 4.0, 6.0, 8.0)), config)
    frames = Trajectory(np.arange(5.0), ahead(7.0, 8.2, 9.4, 10.6, 11.8))
    found = external.corrected(frames, None, ())
    np.testing.assert_allclose(found.T_map_odom, ahead(0.0, 0.2, 0.4, 0.6, 0.8), atol=1e-12)
    np.testing.assert_allclose(
        found.corrected.T_world_cam, ahead(0.0, 2.4, 4.8, 7.2, 9.6), atol=1e-12
    )
    in_metres = found.given.enlarged(0.5).T_world_cam
    np.testing.assert_allclose(
        found.T_map_odom @ in_metres, found.corrected.enlarged(0.5).T_world_cam, atol=1e-12
    )


def test_what_takes_one_to_the_other_holds_where_both_turn(walk, drifting, T_base_cam):
    mount = (*T_base_cam[:3, 3].tolist(), *se3.to_quaternion(T_base_cam[:3, :3]).tolist())
    config = OdometryConfig(T_base_cam=mount, scale=0.5)
    convention = Convention(T_base_cam, 0.5)
    odometry = drifting(walk, rad=0.01, m=0.02)
    found = filled(convention.as_given(odometry), config).corrected(walk, None, ())
    before, after = (
        convention.camera_poses(each).T_world_cam for each in (found.given, found.corrected)
    )
    np.testing.assert_allclose(found.T_map_odom @ before, after, atol=1e-9)
    start = before[0] @ se3.inverse(walk.T_world_cam[0])
    np.testing.assert_allclose(after, start @ walk.T_world_cam, atol=1e-9)


def test_poses_that_come_between_frames_are_corrected_too():
    external = filled(Trajectory(np.arange(9) / 10, ahead(*np.arange(9) / 10)))
    frames = Trajectory(np.array([0.2, 0.6]), ahead(5.0, 5.8))  # twice as far
    found = external.corrected(frames, None, ())
    expected = [0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.1, 1.2]
    np.testing.assert_allclose(found.corrected.T_world_cam[:, 0, 3], expected, atol=1e-12)


def test_without_a_frame_in_common_nothing_is_known_of_the_poses():
    external = filled(steady([0.0, 0.1, 0.2]))
    found = external.corrected(Trajectory(np.array([5.0, 6.0]), ahead(0.0, 1.0)), None, ())
    assert len(found.given) == 3
    assert len(found.corrected) == len(found.T_map_odom) == 0
    assert np.isnan(carried(steady([0.0, 0.1]), steady([5.0, 6.0]))).all()


def test_what_the_images_say_of_it_comes_with_the_corrected_poses(tracked):
    external = filled(tracked)
    keyframes = external.read([tracked], np.arange(10.0))
    assert len(keyframes) == 10
    step = Link(0, 1, RelativePose(np.eye(4), np.eye(6)))
    trust = Trust(Verdict.NOISY, NOTHING, NOTHING, (4, 5), (step,), 77)
    found = external.corrected(tracked, trust, ())
    assert Verdict.NOISY in found.verdict and "77" in found.verdict
    (sentence,) = found.warnings
    assert "3.00 to 5.00 s" in sentence


def test_poses_of_another_recording_are_not_used(tracked):
    steps = np.random.default_rng(0).normal(0.0, 0.2, (len(tracked), 6))
    external = filled(Trajectory(tracked.timestamps_s, se3.exp(np.cumsum(steps, axis=0))))
    assert external.read([tracked], np.arange(10.0)) == {}
    found = external.corrected(tracked, None, ())
    assert not found.fits
    assert "not used" in found.warnings[0]


def test_without_poses_there_is_nothing_to_read(tracked):
    assert ExternalOdometry(OdometryConfig()).read([tracked], np.arange(3.0)) == {}


def test_a_pose_at_a_frame_is_carried_to_where_the_frame_is(walk, drifting):
    odometry = drifting(walk, rad=0.01, m=0.02)
    some = slice(0, 600, 7)
    frames = Trajectory(walk.timestamps_s[some], walk.T_world_cam[some])
    found = carried(odometry, frames)
    np.testing.assert_allclose(found[some], frames.T_world_cam, atol=1e-9)
    # Frames and odometry that agree leave everything where it is.
    np.testing.assert_allclose(carried(walk, frames), walk.T_world_cam, atol=1e-9)


def test_between_two_frames_the_bend_is_shared_out_by_time():
    stamps_s = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    given = Trajectory(stamps_s, ahead(0.0, 0.0, 0.3, 0.3, 1.0))  # it stood still at first
    found = carried(given, Trajectory(stamps_s[[0, 4]], ahead(0.0, 1.4)))
    np.testing.assert_allclose(found[:, 0, 3], [0.0, 0.1, 0.5, 0.6, 1.4], atol=1e-12)


def test_before_the_first_frame_and_after_the_last_the_odometry_is_believed(walk):
    elsewhere = se3.exp(np.array([0.5, -0.2, 1.0, 3.0, 2.0, -1.0]))
    middle = slice(200, 400)
    bent = elsewhere @ walk.T_world_cam[middle]
    bent[-1] = bent[-1] @ se3.exp(np.array([0.0, 0.1, 0.0, 0.2, 0.0, 0.0]))
    found = carried(walk, Trajectory(walk.timestamps_s[middle], bent))
    np.testing.assert_allclose(found[:200], elsewhere @ walk.T_world_cam[:200], atol=1e-9)
    end = bent[-1] @ se3.inverse(walk.T_world_cam[399])
    np.testing.assert_allclose(found[400:], end @ walk.T_world_cam[400:], atol=1e-9)


def test_frames_between_poses_that_are_too_far_apart_carry_nothing():
    given = Trajectory(np.array([0.0, 0.1, 0.2, 5.0, 5.1]), ahead(0.0, 0.1, 0.2, 5.0, 5.1))
    frames = Trajectory(np.array([0.0, 2.0, 5.0]), ahead(0.0, 99.0, 5.0))
    np.testing.assert_allclose(carried(given, frames), given.T_world_cam, atol=1e-12)

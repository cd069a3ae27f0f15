# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from pydantic import ValidationError

from slam.config import MotionConfig
from slam.geometry import se3
from slam.tracking.smoothing import smoothed
from slam.types import Trajectory

START_S, FRAMES_PER_S = 1e9, 30.0
AS_TRACKED = MotionConfig(acceleration_m_s2=1e9, angular_acceleration_rad_s2=1e9)


def carried(times_s):
    """Return a camera swung by hand: 20 cm each way, once in three seconds, turning as it goes."""
    phase = 2.0 * np.pi * (times_s - START_S) / 3.0
    turns = 0.6 * np.column_stack([np.sin(phase), np.cos(2.0 * phase), phase])
    T_world_cam = np.array([se3.exp(np.concatenate([turn, np.zeros(3)])) for turn in turns])
    T_world_cam[:, :3, 3] = 0.2 * np.column_stack([np.sin(phase), np.cos(phase), phase])
    return Trajectory(times_s, T_world_cam)


def shaken(truth, position_m=0.01, rotation_rad=0.005):
    rng = np.random.default_rng(0)
    sigmas = [rotation_rad] * 3 + [position_m] * 3
    noise = rng.normal(size=(len(truth), 6)) * sigmas
    T_world_cam = truth.T_world_cam @ np.array([se3.exp(each) for each in noise])
    return Trajectory(truth.timestamps_s, T_world_cam)


def errors(estimate, truth):
    """Return the root mean squares of position, metres, and rotation, radians."""
    off = np.array([se3.inverse(T) for T in truth.T_world_cam]) @ estimate.T_world_cam
    both = (se3.translation_norm(off), se3.rotation_angle(off))
    return [np.sqrt(np.mean(values**2)) for values in both]


@pytest.fixture
def truth():
    return carried(START_S + np.arange(300) / FRAMES_PER_S)


def test_what_a_hand_cannot_have_done_is_taken_out(truth):
    tracked = shaken(truth)
    position_m, rotation_rad = errors(smoothed(tracked, MotionConfig()), truth)
    assert position_m < 0.6 * errors(tracked, truth)[0]
    assert rotation_rad < 0.8 * errors(tracked, truth)[1]


def test_a_faster_carrier_is_followed(truth):
    faster = Trajectory(truth.timestamps_s[0] + np.arange(300) / 300.0, truth.T_world_cam)
    hand, drone = MotionConfig(), MotionConfig(acceleration_m_s2=40.0)
    assert errors(smoothed(faster, drone), faster)[0] < errors(smoothed(faster, hand), faster)[0]


def test_what_a_hand_does_is_left_as_it_is(truth):
    position_m, rotation_rad = errors(smoothed(truth, MotionConfig()), truth)
    assert position_m < 1e-3 and rotation_rad < 1e-2


def test_a_steady_motion_is_left_as_it_is_at_uneven_times():
    times_s = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.19, 50))
    speed = np.array([0.0, 0.0, 0.8, 0.5, -0.2, 0.1])
    steady = Trajectory(times_s, np.array([se3.exp(speed * [t, t, t, 0, 0, 0]) for t in times_s]))
    steady.T_world_cam[:, :3, 3] = times_s[:, None] * speed[3:]
    same = smoothed(steady, MotionConfig())
    np.testing.assert_allclose(same.T_world_cam, steady.T_world_cam, atol=1e-3)
    np.testing.assert_allclose(same.T_world_cam[:, :3, 3], steady.T_world_cam[:, :3, 3], atol=1e-9)


def test_without_a_limit_frames_stay_where_they_were_tracked(truth):
    tracked = shaken(truth)
    np.testing.assert_allclose(
        smoothed(tracked, AS_TRACKED).T_world_cam, tracked.T_world_cam, atol=1e-9
    )


def test_frames_stamped_in_bursts_are_not_thrown_about(truth):
    times_s = truth.timestamps_s.copy()
    times_s[1::3], times_s[2::3] = times_s[::3] + 1e-6, times_s[::3] + 2e-6
    in_bursts = carried(times_s)
    assert errors(smoothed(in_bursts, MotionConfig()), in_bursts)[0] < 5e-3


def test_no_motion_at_all_is_no_setting():
    with pytest.raises(ValidationError, match=r"greater than or equal to 0\.01"):
        MotionConfig(acceleration_m_s2=1e-9)


def moved(trajectory, first, by_m):
    T_world_cam = trajectory.T_world_cam.copy()
    T_world_cam[first:, 0, 3] += by_m
    return Trajectory(trajectory.timestamps_s, T_world_cam)


def test_frames_of_two_sessions_do_not_pull_at_each_other(truth):
    elsewhere = moved(truth, 150, 3.0)
    starts_s = [truth.timestamps_s[150]]
    apart = smoothed(elsewhere, MotionConfig(), starts_s)
    assert errors(apart, elsewhere)[0] < 1e-3
    assert errors(smoothed(elsewhere, MotionConfig()), elsewhere)[0] > 0.1


def test_frames_before_and_after_a_long_gap_do_not_pull_at_each_other(truth):
    times_s = truth.timestamps_s + np.where(np.arange(300) >= 150, 0.5, 0.0)
    elsewhere = moved(Trajectory(times_s, truth.T_world_cam), 150, 3.0)
    assert errors(smoothed(elsewhere, MotionConfig()), elsewhere)[0] < 1e-3


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_frames(count, truth):
    few = Trajectory(truth.timestamps_s[:count], truth.T_world_cam[:count])
    same = smoothed(few, MotionConfig())
    np.testing.assert_allclose(same.T_world_cam, few.T_world_cam, atol=5e-3)


def test_rotations_stay_rotations_and_what_was_given_stays(truth):
    tracked = shaken(truth, rotation_rad=0.1)
    before = tracked.T_world_cam.copy()
    R = smoothed(tracked, MotionConfig()).T_world_cam[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (300, 1, 1)), atol=1e-9)
    np.testing.assert_array_equal(tracked.T_world_cam, before)

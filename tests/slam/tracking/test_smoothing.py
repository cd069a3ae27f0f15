# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest

from slam.geometry import se3
from slam.tracking.smoothing import smoothed
from slam.types import Trajectory

START_S, SECONDS = 1e9, 12.0
POSITION_M, ROTATION_RAD = 0.003, np.radians(0.1)


def swing(times_s, frequency_hz, amplitude=1.0):
    return amplitude * np.sin(2.0 * np.pi * frequency_hz * times_s)


def ahead(times_s, speed_m_s):
    """Return positions along a line and no turning, to be added to."""
    return np.outer(times_s, [speed_m_s, 0.0, 0.0]), np.zeros((len(times_s), 3))


def walking(times_s):
    positions_m, turns_rad = ahead(times_s, 1.2)
    positions_m[:, 1] = swing(times_s, 1.0, 0.015)
    positions_m[:, 2] = swing(times_s, 2.0, 0.03)
    turns_rad[:, 0] = swing(times_s, 2.0, 0.02)
    return positions_m, turns_rad


def running(times_s):
    positions_m, turns_rad = ahead(times_s, 3.0)
    positions_m[:, 2] = swing(times_s, 3.0, 0.04)
    turns_rad[:, 0] = swing(times_s, 3.0, 0.03)
    return positions_m, turns_rad


def robot(times_s, frequency_hz=6.0):
    positions_m, turns_rad = ahead(times_s, 0.5)
    turns_rad[:, 0] = swing(times_s, frequency_hz, np.radians(1.0))
    turns_rad[:, 2] = 0.1 * times_s
    return positions_m, turns_rad


def fast_robot(times_s):
    return robot(times_s, 10.0)


def calm_hand(times_s):
    swings = [swing(times_s, each, 0.1) for each in (0.5, 0.37, 0.6)]
    turns = [swing(times_s, each, 0.2) for each in (0.5, 0.4, 0.3)]
    return np.column_stack(swings), np.column_stack(turns)


def straight(times_s):
    return ahead(times_s, 0.2)


def standing(times_s):
    return ahead(times_s, 0.0)


def corner(times_s):
    """Turn by 90 degrees within 0.2 s, halfway, and go on another way."""
    half_s = times_s.mean()
    positions_m, turns_rad = ahead(times_s, 0.0)
    positions_m[:, 0] = np.minimum(times_s, half_s)
    positions_m[:, 1] = np.maximum(times_s - half_s, 0.0)
    turns_rad[:, 1] = np.clip((times_s - half_s) / 0.2, 0.0, 1.0) * np.pi / 2.0
    return positions_m, turns_rad


def half_shaky(times_s):
    positions_m, turns_rad = straight(times_s)
    is_shaky = times_s > times_s.mean()
    positions_m[:, 2] = is_shaky * swing(times_s, 3.0, 0.04)
    turns_rad[:, 0] = is_shaky * swing(times_s, 6.0, np.radians(1.0))
    return positions_m, turns_rad


def turning_by_jerks(times_s):
    """Go to and fro, 2 s each way, and turn by 90 degrees within 0.1 s at each end."""
    positions_m, turns_rad = ahead(times_s, 0.0)
    turns, since_s = np.divmod(times_s, 2.0)
    positions_m[:, 0] = np.where(turns % 2, 2.0 - since_s, since_s)
    turns_rad[:, 1] = (turns + np.clip((since_s - 1.9) / 0.1, 0.0, 1.0)) * np.pi / 2.0
    return positions_m, turns_rad


def shaken_ever_faster(times_s):
    """Walk ever faster: 1 to 7 steps a second."""
    positions_m, turns_rad = straight(times_s)
    steps = times_s + 6.0 * times_s**2 / (2.0 * times_s[-1])
    positions_m[:, 2] = swing(steps, 1.0, 0.02)
    turns_rad[:, 0] = swing(steps, 1.0, np.radians(0.8))
    return positions_m, turns_rad


MOTIONS = (
    *(walking, running, robot, fast_robot, calm_hand, straight, standing, corner),
    *(half_shaky, turning_by_jerks, shaken_ever_faster),
)


def moved_by(motion, times_s):
    positions_m, turns_rad = motion(times_s)
    T_world_cam = np.array([se3.exp(np.append(turn, [0.0, 0.0, 0.0])) for turn in turns_rad])
    T_world_cam[:, :3, 3] = positions_m
    return Trajectory(START_S + times_s, T_world_cam)


def shaken(truth, correlation=0.0, seed=0):
    """Place every frame with an error, which may be like that of the frame before."""
    errors = np.random.default_rng(seed).normal(size=(len(truth), 6))
    for before, after in pairwise(errors):
        after *= np.sqrt(1.0 - correlation**2)
        after += correlation * before
    errors *= [ROTATION_RAD] * 3 + [POSITION_M] * 3
    T_world_cam = truth.T_world_cam @ np.array([se3.exp(each) for each in errors])
    return Trajectory(truth.timestamps_s, T_world_cam)


def errors(estimate, truth, chosen=slice(None)):
    """Return the root mean squares of position, metres, and rotation, radians."""
    off = se3.inverse(truth.T_world_cam[chosen]) @ estimate.T_world_cam[chosen]
    both = (se3.translation_norm(off), se3.rotation_angle(off))
    return np.array([np.sqrt(np.mean(values**2)) for values in both])


def share_left(truth, tracked, breaks_s=()):
    return errors(smoothed(tracked, breaks_s), truth) / errors(tracked, truth)


def at_even_times(frames_per_s):
    return np.arange(int(SECONDS * frames_per_s)) / frames_per_s


@pytest.fixture
def hand():
    return moved_by(calm_hand, at_even_times(30.0))


@pytest.mark.parametrize("frames_per_s", [15.0, 30.0, 60.0])
@pytest.mark.parametrize("motion", MOTIONS)
def test_no_motion_is_made_worse(motion, frames_per_s):
    truth = moved_by(motion, at_even_times(frames_per_s))
    assert (share_left(truth, shaken(truth)) <= 1.02).all()


@pytest.mark.parametrize("motion", MOTIONS)
def test_no_motion_is_made_worse_where_frames_are_missing_and_stamped_unevenly(motion):
    rng = np.random.default_rng(1)
    times_s = np.arange(300) / 15.0
    times_s = times_s[rng.uniform(size=300) > 0.2]
    truth = moved_by(motion, times_s + rng.uniform(-0.01, 0.01, len(times_s)))
    assert (share_left(truth, shaken(truth)) <= 1.02).all()


@pytest.mark.parametrize("motion", MOTIONS)
def test_errors_that_last_over_frames_are_not_taken_for_noise_with_the_motion(motion):
    truth = moved_by(motion, at_even_times(30.0))
    assert (share_left(truth, shaken(truth, correlation=0.7)) <= 1.02).all()


@pytest.mark.parametrize("motion", [calm_hand, straight, standing])
def test_calm_cameras_are_rid_of_much_of_the_noise(motion):
    truth = moved_by(motion, at_even_times(30.0))
    assert (share_left(truth, shaken(truth)) < 0.65).all()


def test_positions_and_rotations_are_told_apart():
    truth = moved_by(fast_robot, at_even_times(30.0))
    position, rotation = share_left(truth, shaken(truth))
    assert position < 0.65 and rotation == pytest.approx(1.0, abs=0.02)


def test_the_calm_half_of_a_shaky_run_is_smoothed():
    truth = moved_by(half_shaky, at_even_times(30.0))
    tracked = shaken(truth)
    calm, same = slice(0, 120), smoothed(tracked)
    assert (errors(same, truth, calm) < 0.65 * errors(tracked, truth, calm)).all()


@pytest.mark.parametrize("motion", MOTIONS)
def test_without_noise_nothing_is_smoothed(motion):
    truth = moved_by(motion, at_even_times(30.0))
    assert (errors(smoothed(truth), truth) < [POSITION_M / 10.0, ROTATION_RAD / 10.0]).all()


def jumped(trajectory, first, by_m):
    T_world_cam = trajectory.T_world_cam.copy()
    T_world_cam[first:, 0, 3] += by_m
    return Trajectory(trajectory.timestamps_s, T_world_cam)


@pytest.mark.parametrize("by_m", [0.02, 3.0])
def test_a_break_stays_sharp_and_both_sides_are_smoothed(hand, by_m):
    truth, tracked = jumped(hand, 170, by_m), jumped(shaken(hand), 170, by_m)
    broken = smoothed(tracked, [hand.timestamps_s[170]])
    near = slice(150, 190)
    left = errors(broken, truth, near)[0]
    assert left < 0.8 * errors(tracked, truth, near)[0]
    assert left < 0.9 * errors(smoothed(tracked), truth, near)[0]
    unbroken = smoothed(shaken(hand), [hand.timestamps_s[170]])
    np.testing.assert_allclose(broken.T_world_cam, jumped(unbroken, 170, by_m).T_world_cam)


def test_a_gap_in_time_is_a_break(hand):
    later = np.where(np.arange(len(hand)) >= 170, 0.5, 0.0)
    truth = jumped(Trajectory(hand.timestamps_s + later, hand.T_world_cam), 170, 3.0)
    tracked, near = shaken(truth), slice(150, 190)
    same = smoothed(tracked)
    assert errors(same, truth, near)[0] < 0.8 * errors(tracked, truth, near)[0]
    there = smoothed(tracked, [truth.timestamps_s[170]])
    np.testing.assert_array_equal(there.T_world_cam, same.T_world_cam)


def test_stretches_of_a_frame_or_two_stay_as_they_were(hand):
    tracked = shaken(hand)
    same = smoothed(tracked, hand.timestamps_s[::2])
    np.testing.assert_allclose(same.T_world_cam, tracked.T_world_cam, atol=1e-12)


def test_frames_stamped_in_bursts_are_not_thrown_about(hand):
    times_s = hand.timestamps_s - START_S
    times_s[1::3], times_s[2::3] = times_s[::3] + 1e-6, times_s[::3] + 2e-6
    truth = moved_by(calm_hand, times_s)
    assert (share_left(truth, shaken(truth)) <= 1.02).all()


@pytest.mark.parametrize("count", [0, 1, 2, 3, 60])
def test_too_few_frames_to_tell_stay_as_they_were(count, hand):
    tracked = shaken(hand)
    few = Trajectory(tracked.timestamps_s[:count], tracked.T_world_cam[:count])
    np.testing.assert_array_equal(smoothed(few).T_world_cam, few.T_world_cam)


def test_rotations_stay_rotations_and_what_was_given_stays(hand):
    tracked = shaken(hand)
    before = tracked.T_world_cam.copy()
    R = smoothed(tracked).T_world_cam[:, :3, :3]
    unit = np.tile(np.eye(3), (len(hand), 1, 1))
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), unit, atol=1e-9)
    np.testing.assert_array_equal(tracked.T_world_cam, before)


def test_the_same_frames_give_the_same_bits(hand):
    first, second = (smoothed(shaken(hand)).T_world_cam for _ in range(2))
    np.testing.assert_array_equal(first, second)

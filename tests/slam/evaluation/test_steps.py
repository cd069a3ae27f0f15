# SPDX-License-Identifier: Apache-2.0
"""Steps that no camera makes are told from all that cameras do."""

import re

import numpy as np
import pytest

from slam.evaluation.steps import impossible_steps
from slam.evaluation.trajectory import read_tum
from slam.geometry import se3
from slam.types import Trajectory

TIMES_S = 100.0 + np.arange(600) / 30.0


def path(positions_m, turned_rad=None, times_s=TIMES_S):
    turned_rad = np.zeros((len(times_s), 3)) if turned_rad is None else turned_rad
    T_world_cam = se3.exp(np.concatenate([turned_rad, np.zeros_like(turned_rad)], axis=1))
    T_world_cam[:, :3, 3] = positions_m
    return Trajectory(times_s, T_world_cam)


def columns(*values, times_s=TIMES_S):
    return np.stack([np.zeros(len(times_s)) + each for each in values], axis=1)


def strolled(times_s=TIMES_S, noise_m=0.002):
    """Return (N, 3), a calm walk round a table, as it is tracked."""
    angle = 0.3 * times_s
    noise = np.random.default_rng(1).normal(0.0, noise_m, (len(times_s), 3))
    return columns(np.cos(angle), np.sin(angle), 0.1 * np.sin(2 * angle), times_s=times_s) + noise


def stepped(size_m, duration_s, at_s=110.0, times_s=TIMES_S):
    """Return the walk with a step of this size along x, evenly over a duration."""
    share = np.clip((times_s - at_s) / duration_s, 0.0, 1.0)
    return path(strolled(times_s) + columns(size_m * share, 0, 0, times_s=times_s), None, times_s)


def times_of(sentence):
    return [float(each) for each in re.findall(r"([\d.]+) s\b", sentence)]


@pytest.mark.parametrize("frames_per_s", [15.0, 30.0, 60.0])
def test_a_step_of_26_cm_in_a_fifth_of_a_second_is_named_with_its_time(frames_per_s):
    times_s = 100.0 + np.arange(20.0 * frames_per_s) / frames_per_s
    (warning,) = impossible_steps(stepped(0.26, 0.2, times_s=times_s))
    assert re.search(r"jump by 0\.[12]\d m between 1(09|10)\.\d{3} s and 110\.\d{3} s", warning)
    start_s, end_s = times_of(warning)
    assert 109.8 < start_s < end_s < 110.4
    assert "before and after may not fit together" in warning


@pytest.mark.parametrize("size_m", [0.05, 0.26, 3.0])
def test_a_step_between_two_frames_is_named_once(size_m):
    (warning,) = impossible_steps(stepped(size_m, 1e-3))
    assert f"by {size_m:.2f} m" in warning
    np.testing.assert_allclose(times_of(warning), [110.0, 110.033], atol=1e-3)


def test_a_turn_between_two_frames_is_named():
    turned_rad = columns(0.3 * np.sin(TIMES_S), np.where(TIMES_S > 110.01, np.deg2rad(14.0), 0), 0)
    (warning,) = impossible_steps(path(strolled(), turned_rad))
    assert "jump by 14 degrees between 110.000 s and 110.033 s" in warning


def test_the_largest_are_named_in_the_order_of_time():
    walk = strolled()
    for at_s, size_m in ((103.0, 0.2), (106.0, 0.4), (110.0, 0.1), (113.0, 0.3), (116.0, 0.12)):
        walk[at_s < TIMES_S, 1] += size_m
    warnings = impossible_steps(path(walk))
    assert [round(times_of(each)[0]) for each in warnings] == [103, 106, 113]
    assert warnings[-1].endswith("2 smaller jumps are not named")
    assert not warnings[0].endswith("named")


@pytest.mark.parametrize(
    ("frequency_hz", "amplitude_m"), [(2.0, 0.03), (3.0, 0.04)], ids=["walking", "running"]
)
def test_bobbing_is_no_step(frequency_hz, amplitude_m):
    bob = amplitude_m * np.sin(2 * np.pi * frequency_hz * TIMES_S)
    assert impossible_steps(path(strolled() + columns(0, 0, bob))) == ()


def test_a_vibrating_robot_makes_no_step():
    shaken = columns(np.deg2rad(1.0) * np.sin(2 * np.pi * 6.0 * TIMES_S), 0, 0)
    assert impossible_steps(path(strolled(), shaken)) == ()


def test_starting_stopping_and_turning_back_at_once_are_no_steps():
    moved = 1.5 * np.clip(TIMES_S - 105.0, 0.0, 3.0)
    there_and_back = np.abs(TIMES_S % 4.0 - 2.0)
    assert impossible_steps(path(columns(moved, there_and_back, 0))) == ()


def test_a_whip_pan_is_no_step():
    since_s = TIMES_S % 3.0
    speed = np.where(since_s < 0.4, 6.0 * np.sin(np.pi * np.minimum(since_s / 0.4, 1.0)), 0.0)
    turned_rad = columns(0, np.cumsum(speed) / 30.0, 0)
    assert np.rad2deg(speed.max()) > 340.0
    assert impossible_steps(path(strolled(), turned_rad)) == ()


def test_a_still_camera_makes_no_step():
    assert impossible_steps(path(columns(0, 0, 0))) == ()
    assert impossible_steps(path(1e-3 * np.random.default_rng(0).normal(size=(600, 3)))) == ()


def test_frames_stamped_in_a_burst_make_no_step():
    late_s = TIMES_S.copy()
    for i in range(30, 590, 100):
        late_s[i : i + 3] = late_s[i + 3] - 1e-3 * np.arange(3, 0, -1)
    assert impossible_steps(path(strolled() + columns(0.8 * TIMES_S, 0, 0), None, late_s)) == ()


@pytest.mark.parametrize("gap_s", [0.3, 10.0])
def test_where_frames_are_missing_nothing_is_known(gap_s):
    later_s = np.where(TIMES_S > 110.0, TIMES_S + gap_s, TIMES_S)
    walk = strolled()
    walk[TIMES_S > 110.0] += 0.5
    assert impossible_steps(path(walk, None, later_s)) == ()


def test_a_session_starts_anywhere():
    recording = stepped(2.0, 1e-3, at_s=110.0)
    assert impossible_steps(recording, [TIMES_S[TIMES_S > 110.0001][0]]) == ()
    assert len(impossible_steps(recording)) == 1


@pytest.mark.parametrize("count", [0, 1, 2, 9])
def test_a_few_frames_say_nothing(count):
    few = strolled()[:count]
    few[count // 2 :] += 1.0
    assert impossible_steps(path(few, None, TIMES_S[:count])) == ()


@pytest.mark.parametrize("name", ["desk", "xyz"])
@pytest.mark.parametrize("every", [3, 6], ids=["33 Hz", "17 Hz"])
def test_a_real_hand_makes_no_step_and_one_put_into_its_path_is_found(data, name, every):
    file = data / f"rgbd_dataset_freiburg1_{name}" / "groundtruth.txt"
    if not file.is_file():
        pytest.skip(f"no ground truth of fr1_{name} in {data} (LOOPCLOSE_DATA)")
    truth = read_tum(file)
    times_s, T_world_cam = truth.timestamps_s[::every], truth.T_world_cam[::every].copy()
    assert impossible_steps(Trajectory(times_s, T_world_cam)) == ()
    for at_s in np.linspace(times_s[0] + 1.0, times_s[-1] - 1.0, 10):
        T_stepped = T_world_cam.copy()
        T_stepped[:, 1, 3] += 0.26 * np.clip((times_s - at_s) / 0.1, 0.0, 1.0)
        assert impossible_steps(Trajectory(times_s, T_stepped))

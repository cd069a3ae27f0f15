# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from placerec.datasets.times import FRAMES_PER_S, MICROSECONDS, in_order, in_seconds, like_images
from placerec.errors import LoopcloseError

FILE = Path("rgb.txt")
NOW_S = 1_305_031_453.359684
TICKS_S = np.arange(30) / FRAMES_PER_S
PER_S = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


def ordered(stamps_s, clock=None):
    warnings = []
    return in_order(np.asarray(stamps_s, np.float64), FILE, warnings, clock), warnings


@pytest.mark.parametrize("start_s", [NOW_S, 0.0, 4.0, 86_000.0])
@pytest.mark.parametrize("name", PER_S)
@pytest.mark.parametrize("step_s", [1 / 90, 1 / 30, 1 / 7.5, 0.5, 1.0])
def test_another_unit_is_known_by_the_steps_and_named(start_s, name, step_s):
    warnings = []
    times_s = start_s + step_s * np.arange(10)
    stamps = np.round(times_s * PER_S[name])
    found_s = in_seconds(stamps, FILE, warnings, are_whole=True)
    np.testing.assert_allclose(found_s, times_s, atol=6e-4)
    (said,) = warnings
    assert said.startswith("rgb.txt steps by ") and said.endswith(f"was read as {name}")


@pytest.mark.parametrize("step_s", [1e-3, 1 / 90, 1 / 30, 0.5, 1.5])
@pytest.mark.parametrize("start_s", [NOW_S, 0.0, 100.0])
def test_seconds_are_seconds_without_a_word(start_s, step_s):
    warnings = []
    times_s = start_s + step_s * np.arange(10)
    np.testing.assert_array_equal(in_seconds(times_s, FILE, warnings, are_whole=False), times_s)
    assert warnings == []


def test_views_rendered_every_ten_seconds_are_no_milliseconds():
    views_s = 10.0 * np.arange(5)
    np.testing.assert_array_equal(in_seconds(views_s, FILE, [], are_whole=False), views_s)
    # Of whole seconds since 1970 nobody takes a time lapse for anything else.
    np.testing.assert_array_equal(in_seconds(1.3e9 + views_s, FILE, [], are_whole=True)[0], 1.3e9)


@pytest.mark.parametrize("every", [1, 2, 5])
def test_numbers_of_images_are_taken_at_30_a_second(every):
    warnings = []
    numbers = 7.0 + every * np.arange(10)
    np.testing.assert_allclose(in_seconds(numbers, FILE, warnings), numbers / 30.0)
    assert warnings == [f"rgb.txt steps by {every} and was read as numbers of images, 30 a second"]


def test_the_usual_unit_of_a_format_needs_no_word():
    warnings = []
    in_seconds(33_369.0 * np.arange(5), FILE, warnings, usual=MICROSECONDS)
    assert warnings == []
    in_seconds(33.0 * np.arange(5), FILE, warnings, usual=MICROSECONDS)
    assert warnings == ["rgb.txt steps by 33 and was read as milliseconds"]


def test_a_single_time_is_what_is_usual():
    assert in_seconds(np.array([33.0]), FILE, []).tolist() == [33.0]
    assert in_seconds(np.array([NOW_S * 1e9]), FILE, []).tolist() == [pytest.approx(NOW_S)]


def test_steps_that_fit_no_unit_are_refused():
    with pytest.raises(LoopcloseError, match="times follow each other by 1e\\+10; seconds, milli"):
        in_seconds(1e10 * np.arange(3), FILE, [])


@pytest.mark.parametrize("start_s", [NOW_S, 0.0])
@pytest.mark.parametrize("name", PER_S)
@pytest.mark.parametrize("rate_hz", [1, 30, 100, 1000])
def test_poses_are_read_in_the_unit_that_lays_them_on_the_images(start_s, name, rate_hz):
    warnings = []
    poses_s = start_s - 0.2 + np.arange(rate_hz * 25) / rate_hz
    images_s = start_s + np.arange(600) / 30.0
    found_s = like_images(np.round(poses_s * PER_S[name]), images_s, FILE, warnings)
    np.testing.assert_allclose(found_s, poses_s, atol=6e-4)
    assert warnings == [f"the times of rgb.txt were read as {name}, which lays them on the images'"]


@pytest.mark.parametrize("poses_s", [TICKS_S + 5.0, np.arange(20.0), np.array([3.0]), [0.0, 7.5]])
def test_poses_in_seconds_stay_as_they_are(poses_s):
    warnings = []
    images_s = np.arange(600) / 30.0
    np.testing.assert_array_equal(like_images(np.array(poses_s), images_s, FILE, warnings), poses_s)
    assert warnings == []


@pytest.mark.parametrize("first", [0, 1])
def test_poses_may_count_the_images(first):
    warnings = []
    images_s = NOW_S + 0.04 * np.arange(50)
    found_s = like_images(first + np.arange(50.0), images_s, FILE, warnings)
    np.testing.assert_array_equal(found_s, images_s)
    assert "numbers of the images" in warnings[0]


def test_poses_of_another_time_stay_as_they_are():
    warnings = []
    poses_s = np.array([5.25, 5.5])
    np.testing.assert_array_equal(like_images(poses_s, NOW_S + TICKS_S, FILE, warnings), poses_s)
    assert warnings == []


@pytest.mark.parametrize("order", ["backwards", "shuffled", "as ls has it", "late", "halves"])
def test_a_list_out_of_order_is_sorted(order):
    numbers = np.arange(300)
    lines = {
        "backwards": numbers[::-1],
        "shuffled": np.random.default_rng(0).permutation(numbers),
        "as ls has it": np.array(sorted(numbers, key=str)),
        "late": np.argsort(numbers + np.where(numbers % 40 == 20, 5.5, 0.0)),
        "halves": np.roll(numbers, 150),
    }[order]
    timeline, warnings = ordered(NOW_S + lines / 30.0)
    np.testing.assert_allclose(timeline.times_s, NOW_S + numbers / 30.0)
    assert len(timeline.clock.ends_s) == 0
    assert warnings == ["rgb.txt is not in the order of time; it was sorted"]


@pytest.mark.parametrize("sessions", [2, 3])
@pytest.mark.parametrize("shift_s", [0.0, 0.015])
@pytest.mark.parametrize("count", [15, 200])
def test_a_clock_that_starts_again_begins_a_session_behind_the_last(sessions, shift_s, count):
    runs = [k * shift_s + np.arange(count - 2 * k) / 30.0 for k in range(sessions)]
    timeline, (said,) = ordered(np.concatenate(runs))
    assert timeline.kept == list(range(sum(map(len, runs))))
    steps_s = np.diff(timeline.times_s)
    breaks = np.flatnonzero(steps_s > 1.0)
    assert breaks.tolist() == (np.cumsum([len(run) for run in runs])[:-1] - 1).tolist()
    np.testing.assert_allclose(steps_s[breaks], 10.0)
    assert (timeline.times_s[breaks] < timeline.clock.ends_s).all()
    assert f"the clock of rgb.txt starts again {sessions - 1} time(s)" in said


def test_other_lists_of_the_clock_are_moved_alike():
    run_s = np.arange(20) / 30.0
    images, _ = ordered([*run_s, *run_s])
    truth, _ = ordered([*(run_s - 0.01), *(run_s + 0.01)], images.clock)
    np.testing.assert_allclose(truth.times_s[:20], images.times_s[:20] - 0.01)
    np.testing.assert_allclose(truth.times_s[20:], images.times_s[20:] + 0.01)
    with pytest.raises(LoopcloseError, match=r"rgb\.txt starts again 0 time\(s\), that of"):
        ordered(run_s, images.clock)


def test_times_that_were_rounded_are_refused():
    with pytest.raises(LoopcloseError, match=r"19 of 30 lines have the time of another"):
        ordered(np.round(TICKS_S, 1))
    timeline, (said,) = ordered([*TICKS_S, TICKS_S[-1]])
    np.testing.assert_array_equal(timeline.times_s, TICKS_S)
    assert "1 line(s) whose timestamp came before" in said

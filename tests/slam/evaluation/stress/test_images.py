# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.evaluation.stress.images import IMAGE_STRESS
from slam.evaluation.stress.moving_board import NEAR_M, board, covered
from slam.types import Frame

HEIGHT, WIDTH = 120, 160


@pytest.fixture
def frame():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return Frame(1.0, rgb, np.full((HEIGHT, WIDTH), 2.0, np.float32))


def stressed(name, frame, level, number=3, seed=0):
    return IMAGE_STRESS[name](frame, number, level, np.random.default_rng(seed))


@pytest.mark.parametrize("name", IMAGE_STRESS)
def test_nothing_at_level_0_and_the_same_for_the_same_seed(name, frame):
    untouched = stressed(name, frame, 0.0)
    np.testing.assert_array_equal(untouched.rgb, frame.rgb)
    np.testing.assert_array_equal(untouched.depth_m, frame.depth_m)
    a, b = (stressed(name, frame, 0.5, seed=1) for _ in range(2))
    assert (a is None) == (b is None)
    if a:
        np.testing.assert_array_equal(a.rgb, b.rgb)
        assert (a.rgb.dtype, a.depth_m.dtype) == (np.uint8, np.float32)


def test_as_many_frames_are_dropped_as_was_asked_for_and_more_of_them_at_a_higher_level(frame):
    dropped = {
        level: {k for k in range(400) if stressed("dropped-frames", frame, level, seed=k) is None}
        for level in (0.2, 0.6)
    }
    assert dropped[0.2] < dropped[0.6] and 200 < len(dropped[0.6]) < 280


def test_depth_is_lost_in_patches_and_nothing_else(frame):
    lost = stressed("missing-depth", frame, 0.6)
    is_lost = lost.depth_m == 0.0
    assert 0.5 < is_lost.mean() < 0.7 and (is_lost[:, ::4] == is_lost[:, 3::4]).all()
    assert lost.rgb is frame.rgb


def test_a_smear_takes_away_what_is_fine_and_keeps_the_brightness(frame):
    smeared = stressed("blur", frame, 0.05)
    assert smeared.rgb.std() < 0.6 * frame.rgb.std()
    assert smeared.rgb.mean() == pytest.approx(frame.rgb.mean(), abs=1.0)


def test_in_the_dark_there_is_less_light_and_there_is_noise(frame):
    dark = stressed("darkness", frame, 0.9)
    assert dark.rgb.mean() == pytest.approx(0.1 * frame.rgb.mean(), abs=0.5)
    assert np.std(dark.rgb - 0.1 * frame.rgb) > 1.0


def test_the_board_is_near_where_it_is_seen_and_moves(frame):
    first, second = (stressed("moving-object", frame, 0.25, number) for number in (1, 2))
    for each in (first, second):
        is_board = each.depth_m != frame.depth_m
        assert is_board.mean() == pytest.approx(0.25, abs=0.01)
        assert (each.depth_m[is_board] == np.float32(NEAR_M)).all()
        np.testing.assert_array_equal(each.rgb[~is_board], frame.rgb[~is_board])
    assert (first.depth_m != second.depth_m).any()
    whole = covered(frame, board(WIDTH, HEIGHT), 7)
    assert (whole.depth_m == np.float32(NEAR_M)).all()

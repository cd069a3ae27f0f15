# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import numpy as np
import pytest

from slam.loops.candidates.novelty import Novelty
from slam.types import (
    Camera,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    Verification,
)

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)
PIXELS = np.stack(np.meshgrid(np.arange(5.0, 80.0, 10.0), np.arange(5.0, 60.0, 10.0)), -1)
EVERYWHERE = PIXELS.reshape(-1, 2)  # one in each of 8 x 6 parts
LEFT = EVERYWHERE[EVERYWHERE[:, 0] < 40.0]


def keyframe(k, pixels=EVERYWHERE):
    return SimpleNamespace(id=k, camera=None, features=SimpleNamespace(pixels=pixels))


def loop(match_id, pixels=EVERYWHERE, *, is_kept=True):
    motion = RelativePose(np.eye(4), np.eye(6))
    outcome = motion if is_kept else Rejection(RejectionReason.FEW_INLIERS, 1, 2)
    pairs, mask = np.hstack([pixels, pixels]), np.ones(len(pixels), bool)
    return LoopAttempt(9, match_id, 0.9, Verification(outcome, pairs, mask, pairs[:, :3]), outcome)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr("slam.loops.candidates.novelty._ALL_KEPT", 3)


@pytest.fixture
def novelty():
    """Return what has taken three keyframes, all of which were new."""
    novelty = Novelty(CAMERA)
    assert all(novelty.is_new(keyframe(k), []) for k in range(3))
    return novelty


@pytest.mark.parametrize(
    ("attempts", "is_new"),
    [
        ([], True),
        ([loop(0)], True),
        ([loop(0), loop(1)], False),
        ([loop(0), loop(1, is_kept=False)], True),
        ([loop(0), loop(1, LEFT)], True),
        ([loop(0), loop(1, LEFT), loop(2)], False),
        ([loop(0, LEFT), loop(1, LEFT), loop(2, EVERYWHERE)], True),
    ],
    ids=["alone", "one", "two", "refused", "half", "half and two", "two halves and one"],
)
def test_a_view_is_new_unless_two_others_show_nearly_all_of_it(novelty, attempts, is_new):
    assert novelty.is_new(keyframe(3), attempts) == is_new


def test_what_shows_half_is_not_new_where_that_half_was_seen(novelty):
    assert not novelty.is_new(keyframe(3, LEFT), [loop(0), loop(1, LEFT)])


def test_keyframes_that_were_left_out_stand_for_nothing(novelty):
    assert not novelty.is_new(keyframe(3), [loop(0), loop(1)])
    assert novelty.is_new(keyframe(4), [loop(0), loop(3)])
    assert not novelty.is_new(keyframe(5), [loop(0), loop(4)])


def test_a_small_map_keeps_all_and_sorts_them_out_once_it_is_large(monkeypatch):
    monkeypatch.setattr("slam.loops.candidates.novelty._ALL_KEPT", 5)
    novelty, chosen = Novelty(CAMERA), []
    for k in range(7):
        attempts = [loop(0), loop(1)] if k in (3, 5, 6) else []
        assert novelty.is_new(keyframe(k), attempts) == (k < 5)
        chosen.append(novelty.chosen())
    (kept,) = [each for each in chosen if each is not None]
    assert chosen[4] is kept and kept.tolist() == [0, 1, 2, 4]


def test_a_view_of_nothing_is_kept():
    nothing = np.zeros((0, 2))
    assert Novelty(CAMERA).is_new(keyframe(0, nothing), [])

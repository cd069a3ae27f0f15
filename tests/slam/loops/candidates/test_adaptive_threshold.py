# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.loops.candidates.adaptive_threshold import AdaptiveThreshold

CALIBRATED = 0.14


def met(one_place, others=(), distances=None):
    """Return a threshold that met pairs of one place, spread as poses are, and others."""
    one_place, others = np.asarray(one_place, float), np.asarray(others, float)
    if distances is None:
        distances = np.random.default_rng(1).random(len(one_place)) ** (1 / 6)
    threshold = AdaptiveThreshold(CALIBRATED)
    threshold.meet(
        np.concatenate([one_place, others]),
        np.concatenate([distances, np.full(len(others), np.nan)]),
    )
    return threshold


def adapted(*arguments):
    """Return the reliability of the threshold that met these."""
    threshold = met(*arguments)
    return threshold.fit(threshold.min_similarity)


def drawn(mean, spread, count, seed):
    return np.clip(np.random.default_rng(seed).normal(mean, spread, count), -1.0, 1.0)


@pytest.mark.parametrize("shift", [-0.4, 0.0, 0.35])
def test_populations_that_can_be_parted_are_wherever_they_lie(shift):
    right, wrong = drawn(0.55 + shift, 0.1, 500, 2), drawn(0.1 + shift, 0.1, 5000, 3)
    fit = adapted(right, wrong)
    assert (right < fit.min_similarity).mean() <= 0.05
    assert (wrong >= fit.min_similarity).mean() <= 0.30
    assert fit.passing == pytest.approx((wrong >= fit.min_similarity).mean(), abs=0.03)
    assert fit.warnings == ()


def test_where_the_two_collapse_true_pairs_are_kept_and_a_warning_says_so():
    right, wrong = drawn(0.92, 0.02, 500, 2), drawn(0.91, 0.02, 5000, 3)
    fit = adapted(right, wrong)
    assert (right < fit.min_similarity).mean() <= 0.1
    (warning,) = fit.warnings
    assert "hardly tells places apart here" in warning and f"{fit.min_similarity:.3f}" in warning
    assert "--loop.min-similarity adapted" not in warning  # as it is
    (advice,) = replace(fit, min_similarity=0.5).warnings
    assert advice.endswith(f"it is {fit.adapted:.3f}: --loop.min-similarity adapted)")


def test_wrong_pairs_of_two_kinds_are_no_trouble():
    wrong = np.concatenate([drawn(0.0, 0.03, 3000, 3), drawn(0.4, 0.03, 1000, 4)])
    right = drawn(0.7, 0.08, 500, 2)
    fit = adapted(right, wrong)
    assert (right < fit.min_similarity).mean() <= 0.05
    assert (wrong >= fit.min_similarity).mean() <= 0.30


def test_revisits_among_the_others_cost_no_true_pairs():
    right = drawn(0.6, 0.1, 500, 2)
    others = np.concatenate([drawn(0.6, 0.1, 3000, 4), drawn(0.2, 0.05, 2000, 3)])
    fit = adapted(right, others)
    assert (right < fit.min_similarity).mean() <= 0.05
    wrong = others[3000:]
    assert fit.passing == pytest.approx((wrong >= fit.min_similarity).mean(), abs=0.1)


def test_where_all_is_one_place_nobody_knows_what_passes():
    right = drawn(0.6, 0.1, 500, 2)
    fit = adapted(right, drawn(0.6, 0.1, 5000, 3))
    assert np.isnan(fit.passing) and fit.warnings == ()
    assert "an unknown share" in fit.explanation


def test_a_run_without_a_revisit_still_learns():
    right, wrong = drawn(0.5, 0.1, 300, 2), drawn(0.0, 0.05, 5000, 3)
    assert met(right, wrong).min_similarity < 0.1 < CALIBRATED


def test_a_camera_that_stays_where_it_is_learns_nothing():
    threshold = met(np.full(400, 0.99), distances=np.full(400, 0.05))
    assert threshold.min_similarity == pytest.approx(CALIBRATED, abs=1e-3)


def test_what_is_known_to_be_far_is_not_counted():
    threshold = met([0.3, 0.4], distances=np.array([1.0, np.inf]))
    fit = threshold.fit(CALIBRATED)
    assert fit.one_place_pairs == fit.other_pairs == 0


@pytest.mark.parametrize("others", [(), (0.1, 0.2)])
def test_without_neighbours_it_is_the_calibrated_one(others):
    fit = adapted((), others)
    assert fit.min_similarity == CALIBRATED and fit.warnings == ()
    assert "too few to tell" in fit.explanation


def test_a_few_pairs_move_it_a_little():
    first, more = met([0.9] * 2, distances=[0.9] * 2), met([0.9] * 200, distances=[0.9] * 200)
    assert CALIBRATED < first.min_similarity < 0.25 < more.min_similarity < 0.9


def test_it_does_not_matter_in_how_many_parts_pairs_come():
    right, wrong = drawn(0.55, 0.1, 50, 2), drawn(0.1, 0.1, 500, 3)
    whole, parts = met(right, wrong, np.full(50, 0.9)), AdaptiveThreshold(CALIBRATED)
    for each in right:
        parts.meet(np.array([each]), np.array([0.9]))
    parts.meet(wrong, np.full(500, np.nan))
    assert parts.fit(0.3) == whole.fit(0.3)


def test_the_ends_of_the_scale_are_within_it():
    fit = adapted([1.0, -1.0] * 50, [1.0, -1.0] * 50)
    assert -1.0 <= fit.min_similarity <= 1.0


def test_a_threshold_of_elsewhere_that_lets_all_pass_is_told_with_what_would_do():
    right, wrong = drawn(0.8, 0.05, 500, 2), drawn(0.5, 0.05, 5000, 3)
    fit = met(right, wrong).fit(CALIBRATED)
    assert fit.min_similarity == CALIBRATED and fit.cut == 0.0
    assert fit.passing == pytest.approx(1.0, abs=0.01)
    assert 0.5 < fit.adapted < 0.75 and f"it is {fit.adapted:.3f}" in fit.warnings[0]


def test_a_few_pairs_are_no_ground_for_a_warning():
    fit = met(drawn(0.8, 0.05, 40, 2), drawn(0.5, 0.05, 5000, 3)).fit(CALIBRATED)
    assert fit.passing > 0.9 and fit.warnings == ()

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placerec.datasets import PlaceDataset, open_dataset
from placerec.errors import RecognizerError
from placerec.evaluation.embeddings import embed_dataset
from placerec.evaluation.precision_recall import (
    Curve,
    best_match_curve,
    best_matches,
    compare,
    evaluate,
    pair_curve,
    recall_at,
)
from placerec.recognizers.gradients import GradientRecognizer


def two_drives(same_place, comparable=None):
    """Return the truth about Q queries against R references."""
    same_place = np.array(same_place, bool)
    queries, references = same_place.shape
    return PlaceDataset(
        name="two drives",
        paths=(Path("none"),) * (queries + references),
        queries=np.arange(queries),
        references=queries + np.arange(references),
        same_place=same_place,
        comparable=np.ones_like(same_place) if comparable is None else np.array(comparable, bool),
    )


def one_drive(same_place, comparable):
    """Return the truth about N images, each compared with the others."""
    dataset = two_drives(same_place, comparable)
    everyone = np.arange(len(same_place))
    return replace(
        dataset, paths=dataset.paths[: len(everyone)], queries=everyone, references=everyone
    )


# By hand: falling similarities 0.9 right, 0.8 wrong, 0.7 right, 0.6 wrong (each of another query).
HAND = two_drives([[1, 0], [0, 1]])
HAND_SIMILARITIES = np.array([[0.9, 0.8], [0.6, 0.7]], np.float32)


def test_pair_curve_by_hand():
    curve = pair_curve(HAND_SIMILARITIES, HAND)
    assert np.allclose(curve.thresholds, [0.9, 0.8, 0.7, 0.6])
    assert np.allclose(curve.precision, [1, 1 / 2, 2 / 3, 2 / 4])
    assert np.allclose(curve.recall, [1 / 2, 1 / 2, 1, 1])
    assert curve.area == pytest.approx(1 / 2 + 1 / 2 * 2 / 3)
    assert curve.recall_at_full_precision == 0.5


def test_equal_similarities_share_one_point():
    curve = pair_curve(np.array([[0.9, 0.9], [0.1, 0.9]], np.float32), HAND)
    assert np.allclose(curve.thresholds, [0.9, 0.1])
    assert np.allclose(curve.precision, [2 / 3, 2 / 4])
    assert np.allclose(curve.recall, [1, 1])
    assert curve.area == pytest.approx(2 / 3)
    assert curve.recall_at_full_precision == 0.0


def test_best_matches_by_hand():
    # Query 0 finds its place at 0.9; 1 an error at 0.8; 2 its place at 0.7; 3 has none, error 0.6.
    truth = two_drives([[1, 0], [0, 1], [0, 1], [0, 0]])
    similarities = np.array([[0.9, 0.1], [0.8, 0.3], [0.2, 0.7], [0.6, 0.5]], np.float32)
    curve = best_match_curve(similarities, truth)
    assert np.allclose(curve.thresholds, [0.9, 0.8, 0.7, 0.6])
    assert np.allclose(curve.precision, [1, 1 / 2, 2 / 3, 2 / 4])
    assert np.allclose(curve.recall, [1 / 3, 1 / 3, 2 / 3, 2 / 3])
    assert curve.recall_at_full_precision == pytest.approx(1 / 3)
    assert curve.area == pytest.approx(1 / 3 + 1 / 3 * 2 / 3)
    assert recall_at(1, similarities, truth) == pytest.approx(2 / 3)
    assert recall_at(2, similarities, truth) == 1.0
    best = best_matches(similarities, truth)
    assert best.queries.tolist() == [0, 1, 2, 3]
    assert best.references.tolist() == [0, 0, 1, 0]
    assert best.are_right.tolist() == [True, False, True, False]


def test_a_query_without_any_comparable_reference_has_no_best_match():
    truth = two_drives([[1, 0], [1, 0]], [[1, 1], [0, 0]])
    best = best_matches(HAND_SIMILARITIES, truth)
    assert best.queries.tolist() == [0]
    assert best.are_right.tolist() == [True]


def test_the_wrong_one_of_two_equal_references_is_the_best_match():
    best = best_matches(np.array([[0.5, 0.5], [0.4, 0.3]], np.float32), HAND)
    assert best.references.tolist() == [1, 0]
    assert not best.are_right.any()


def test_a_tie_with_a_wrong_reference_finds_nothing():
    similarities = np.array([[0.5, 0.5], [0.1, 0.4]], np.float32)
    assert recall_at(1, similarities, HAND) == 0.5
    assert recall_at(2, similarities, HAND) == 1.0
    assert best_match_curve(similarities, HAND).recall_at_full_precision == 0.0


def test_pairs_that_do_not_count_change_nothing():
    truth = two_drives([[1, 0, 1], [0, 1, 0]], [[1, 1, 0], [1, 1, 0]])
    similarities = np.concatenate([HAND_SIMILARITIES, [[0.99], [0.98]]], axis=1)
    assert pair_curve(similarities, truth).area == pair_curve(HAND_SIMILARITIES, HAND).area
    assert np.array_equal(
        best_match_curve(similarities, truth).precision,
        best_match_curve(HAND_SIMILARITIES, HAND).precision,
    )
    assert recall_at(1, similarities, truth) == recall_at(1, HAND_SIMILARITIES, HAND)


def test_each_pair_of_one_drive_counts_once():
    same = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]])
    truth = one_drive(same, 1 - np.eye(3))
    similarities = np.array([[1, 0.9, 0.95], [0.9, 1, 0.3], [0.95, 0.3, 1]], np.float32)
    assert len(pair_curve(similarities, truth).thresholds) == 3
    assert pair_curve(similarities, truth).area == pytest.approx(1 / 2)


def naive_figures(similarities, truth):
    """Return AP, best-match area, its recall without error, and recall@k, by the definitions."""
    q, r = similarities.shape

    def area(matches, total):
        value, before, clean = 0.0, 0.0, 0.0
        for threshold in sorted({s for s, _ in matches}, reverse=True):
            kept = [right for s, right in matches if s >= threshold]
            recall = sum(kept) / total
            value += (recall - before) * sum(kept) / len(kept)
            before = recall
            if all(kept):
                clean = recall
        return value, clean

    pairs = [
        (similarities[i, j], truth.same_place[i, j])
        for i in range(q)
        for j in range(r)
        if truth.comparable[i, j]
    ]
    best, ranks = [], []
    for i in range(q):
        found = [
            (similarities[i, j], truth.same_place[i, j]) for j in range(r) if truth.comparable[i, j]
        ]
        if not found:
            continue
        found.sort(key=lambda match: (-match[0], match[1]))  # wrong before right where equal
        best.append(found[0])
        if any(right for _, right in found):
            wrong_first = [right for _, right in found].index(True)
            ranks.append(sum(1 for _, right in found[:wrong_first] if not right))
    figures = area(best, len(ranks))
    return (
        area(pairs, sum(right for _, right in pairs))[0],
        *figures,
        np.mean([rank < 1 for rank in ranks]),
        np.mean([rank < 3 for rank in ranks]),
    )


@settings(deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 7), st.integers(1, 7), st.sampled_from([2, 5, 1000]))
def test_figures_agree_with_a_naive_count(seed, queries, references, levels):
    rng = np.random.default_rng(seed)
    truth = two_drives(
        rng.random((queries, references)) < 0.4, rng.random((queries, references)) < 0.8
    )
    right = truth.same_place[truth.comparable]
    if not right.any() or right.all():
        return
    # Few levels, so that many similarities are equal.
    similarities = (rng.integers(0, levels, truth.same_place.shape) / levels).astype(np.float32)
    best = best_match_curve(similarities, truth)
    ours = (
        pair_curve(similarities, truth).area,
        best.area,
        best.recall_at_full_precision,
        recall_at(1, similarities, truth),
        recall_at(3, similarities, truth),
    )
    assert np.allclose(ours, naive_figures(similarities, truth))


def test_perfect_embeddings_score_one_and_equal_ones_what_chance_does():
    places = np.repeat(np.arange(4), 3)
    truth = one_drive(places[:, None] == places, 1 - np.eye(12))
    perfect = evaluate(truth, np.eye(4, dtype=np.float32)[places])
    assert perfect.pair_curve.area == perfect.best_match_curve.area == 1.0
    assert perfect.recall_at_1 == perfect.best_match_curve.recall_at_full_precision == 1.0
    constant = evaluate(truth, np.full((12, 7), 1 / np.sqrt(7), np.float32))
    assert constant.pair_curve.area == pytest.approx(12 / 66)  # the share of pairs of one place
    assert constant.recall_at_1 == constant.recall_at_5 == 0.0
    assert constant.recall_at_10 == 1.0  # each query has but nine wrong references


def test_equal_pairs_of_embeddings_tie_exactly():
    rng = np.random.default_rng(0)
    two = rng.normal(size=(2, 513)).astype(np.float32)
    embeddings = (two / np.linalg.norm(two, axis=1, keepdims=True))[np.arange(131) % 2]
    truth = one_drive(np.eye(131), np.ones((131, 131)))
    assert len(np.unique(compare(embeddings, truth))) == 3


class FirstValue:
    """The difference of the first value in the first row: embeddings that are no vectors."""

    looks_back = 0

    def compare(self, queries, references):
        assert queries.shape[1:] == references.shape[1:] == (2, 3)
        return 1 - abs(queries[:, None, 0, 0] - references[None, :, 0, 0])


def test_embeddings_are_compared_as_their_recognizer_does_in_the_order_of_the_dataset():
    embeddings = np.zeros((5, 2, 3), np.float32)
    embeddings[:, 0, 0] = [0.0, 0.5, 0.1, 0.4, 0.8]
    truth = two_drives(np.eye(2, 3))
    found = evaluate(truth, embeddings, FirstValue())
    assert found.similarities == pytest.approx(np.array([[0.9, 0.6, 0.2], [0.6, 0.9, 0.7]]))
    assert found.recall_at_1 == 1.0


@pytest.mark.parametrize(
    ("same_place", "kind"), [(np.zeros((2, 3)), "the same place"), (np.ones((2, 3)), "different")]
)
def test_dataset_that_shows_nothing_is_refused(same_place, kind):
    with pytest.raises(RecognizerError, match=f"^two drives has no pair of images of {kind}"):
        evaluate(two_drives(same_place), np.ones((5, 4), np.float32) / 2)


class Thumbnail:
    """16x12 grey values, the simplest of features."""

    min_similarity = 0.9

    def embed(self, image):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, (16, 12), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
        small -= small.mean()
        return small / np.linalg.norm(small)


@pytest.mark.parametrize(
    ("recognizer", "figures"),
    [
        # The published row, 0.141 / 0.336 / 0.086, is of a thumbnail resized in another way.
        (Thumbnail(), (0.143, 0.352, 0.094)),
        (GradientRecognizer(), (0.356, 0.500, 0.203)),
    ],
)
def test_known_figures_on_fr1_desk(real_data, recognizer, figures):
    desk = open_dataset(str(real_data("rgbd_dataset_freiburg1_desk")))
    result = evaluate(desk, embed_dataset(recognizer, desk).embeddings)
    found = (
        result.pair_curve.area,
        result.recall_at_1,
        result.best_match_curve.recall_at_full_precision,
    )
    assert np.allclose(found, figures, atol=0.002)


def test_threshold_where_precision_and_recall_are_largest_together():
    curve = Curve(np.array([0.9, 0.7, 0.2]), np.array([1.0, 0.8, 0.3]), np.array([0.2, 0.6, 0.9]))
    assert curve.balanced_threshold == 0.7
    nothing = Curve(np.array([0.9, 0.7]), np.zeros(2), np.zeros(2))
    assert nothing.balanced_threshold == 0.9

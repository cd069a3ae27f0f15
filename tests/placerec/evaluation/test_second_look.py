# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.datasets.place_dataset import PlaceDataset
from placerec.evaluation import second_look
from placerec.evaluation.second_look import LOOKED_AT, LocalFeatures, look_again


def texture(seed, height=240, width=320):
    """Return an image full of corners that no other seed has."""
    grey = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8), np.uint8)
    large = cv2.resize(grey, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.repeat(large[..., None], 3, axis=2)


def moved(image, x_px=12, y_px=7):
    return np.ascontiguousarray(np.roll(image, (y_px, x_px), (0, 1)))


def test_the_same_place_scores_above_others():
    scores = LocalFeatures().rerank(moved(texture(0)), [texture(1), texture(0), texture(2)])
    assert scores.argmax() == 1 and scores[1] > 2 * max(scores[0], scores[2])
    assert (scores >= 0).all() and (scores <= 1).all()


def test_a_mirrored_image_is_not_the_same_place():
    image = texture(0)
    mirrored = np.ascontiguousarray(image[:, ::-1])
    same, other = LocalFeatures().rerank(image, [moved(image), mirrored])
    assert other < same / 2


@pytest.mark.parametrize("shape", [(1, 1), (8, 400), (38, 38), (240, 320)])
def test_an_image_without_features_has_nothing_in_common(shape):
    blank = np.full((*shape, 3), 128, np.uint8)
    assert LocalFeatures().rerank(blank, [blank, texture(0)]).tolist() == [0.0, 0.0]


def test_scores_do_not_depend_on_what_was_asked_before():
    images = [texture(0), moved(texture(0)), texture(3)]
    looked = LocalFeatures()
    first = looked.rerank(images[0], images[1:])
    looked.rerank(images[2], images)
    np.testing.assert_array_equal(looked.rerank(images[0], images[1:]), first)
    np.testing.assert_array_equal(LocalFeatures().rerank(images[0], images[1:]), first)
    assert LocalFeatures().rerank(images[0], []).shape == (0,)


class Shown(PlaceDataset):
    """Its image is its number."""

    def __getitem__(self, index):
        return np.full((1, 1, 3), index, np.uint8)


class Scripted:
    """Scores as it is told by the numbers of the two images, and notes what it was asked."""

    def __init__(self, scores=None):
        self.scores, self.asked = scores or {}, []

    def rerank(self, query, candidates):
        pairs = [(int(query.flat[0]), int(each.flat[0])) for each in candidates]
        self.asked += pairs
        return np.array([self.scores.get(pair, 0.0) for pair in pairs])


def shown(count, comparable=None):
    everyone = np.arange(count)
    all_pairs = ~np.eye(count, dtype=bool) if comparable is None else comparable
    paths = tuple(Path(f"{k}.png") for k in everyone)
    return Shown("shown", paths, everyone, everyone, all_pairs, all_pairs)


def test_what_has_most_in_common_comes_first():
    similarities = np.array([[1, 0.8, 0.7], [0.8, 1, 0.1], [0.7, 0.1, 1]], np.float32)
    refined = look_again(similarities, shown(3), Scripted({(0, 2): 0.5}), 0.4)
    np.testing.assert_allclose(refined[0], [1 / 1.6, 0.8 / 1.6, 1.0 / 1.6], rtol=1e-6)
    np.testing.assert_array_equal(refined, refined.T)
    assert refined.dtype == np.float32 and np.abs(refined).max() <= 1


def test_only_the_most_similar_that_count_are_looked_at():
    count = LOOKED_AT + 4
    comparable = np.ones((count, count), bool)
    comparable[:, :2] = False
    similarities = np.tile(np.linspace(1, 0, count, dtype=np.float32), (count, 1))
    asked = Scripted()
    look_again(similarities, shown(count, comparable), asked, 0.0)
    assert asked.asked == [(q, r) for q in range(count) for r in range(2, 2 + LOOKED_AT)]


def test_nobody_is_asked_about_what_has_nothing_to_be_compared_with():
    asked = Scripted()
    similarities = np.eye(3, dtype=np.float32)
    refined = look_again(similarities, shown(3, np.zeros((3, 3), bool)), asked, 0.5)
    assert asked.asked == []
    np.testing.assert_allclose(refined, similarities / 1.5)


def test_matches_are_each_others_nearest_and_near(monkeypatch):
    rng = np.random.default_rng(0)
    ours, theirs = rng.integers(0, 256, (2, 50, 32), np.uint8)
    theirs[[7, 30]] = ours[[20, 3]]
    theirs[30, 0] ^= 0b101
    apart = np.unpackbits(ours[:, None] ^ theirs, axis=2).sum(axis=2)
    assert second_look._mutual_matches(ours, theirs).tolist() == [[3, 30], [20, 7]]
    monkeypatch.setattr(second_look, "_MAX_DISTANCE", 1)
    assert second_look._mutual_matches(ours, theirs).tolist() == [[20, 7]]
    expected = [[i, j] for i, j in enumerate(apart.argmin(axis=1)) if apart[:, j].argmin() == i]
    monkeypatch.setattr(second_look, "_MAX_DISTANCE", 256)
    assert second_look._mutual_matches(ours, theirs).tolist() == expected
    assert second_look._mutual_matches(ours[:0], theirs).shape == (0, 2)

# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.network_choice.domains import ImageSet, judge, overall, second_pass
from placerec.datasets import PlaceDataset

LENGTHS = {"floor1/hall": 9, "floor1/stairs": 2, "floor2/hall": 3}


@pytest.fixture
def clips(tmp_path: Path) -> PlaceDataset:
    paths = []
    for clip, length in LENGTHS.items():
        floor, name = clip.split("/")
        (tmp_path / floor).mkdir(exist_ok=True)
        for number in range(1, length + 1):
            paths.append(tmp_path / floor / f"{name}_frame_{number:06d}.png")
            cv2.imwrite(str(paths[-1]), np.full((90, 160, 3), 9 * len(paths), np.uint8))
    everyone = np.arange(len(paths))
    nothing = np.zeros((len(paths), len(paths)), np.bool_)
    return PlaceDataset("clips", tuple(paths), everyone, everyone, nothing, nothing)


def test_second_pass_finds_neighbours_but_not_the_image_it_was_made_of(clips: PlaceDataset):
    walk = second_pass(clips)
    truth = walk.truth
    assert not np.diag(truth.comparable).any()
    assert np.flatnonzero(truth.same_place[4]).tolist() == [2, 3, 5, 6]
    # Frames in between, and other clips of the floor, may show the same: they do not count.
    assert np.flatnonzero(truth.comparable[0]).tolist() == [1, 2, 6, 7, 8, 11, 12, 13]


def test_second_pass_is_small_and_different_each_time_the_same(clips: PlaceDataset):
    once, again = (second_pass(clips).images for _ in range(2))
    assert len(once) == 2 * len(clips)
    assert {image.shape for image in once} == {(120, 160, 3)}
    assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))
    assert not np.array_equal(once[1], once[len(clips) + 1])


def line(same_place: np.ndarray) -> ImageSet:
    everyone = np.arange(len(same_place))
    paths = tuple(map(Path, map(str, everyone)))
    others = ~np.eye(len(everyone), dtype=np.bool_)
    truth = PlaceDataset("line", paths, everyone, everyone, same_place, others)
    return ImageSet(truth, truth)


def test_each_set_is_judged_by_its_own_embeddings():
    pairs = np.kron(np.eye(2, dtype=np.bool_), np.ones((2, 2), np.bool_))
    right = np.repeat(np.eye(2), 2, axis=0)
    wrong = np.tile(np.eye(2), (2, 1))
    embeddings = np.concatenate([right, right, wrong]).astype(np.float32)
    scores = judge({"a": [line(pairs)], "b": [line(pairs), line(pairs)]}, embeddings)
    assert scores["a"] == 1.0
    assert scores["b"] < 0.8


def test_a_tenth_more_counts_the_same_in_every_domain():
    assert overall({"a": 0.55, "b": 0.1}) == pytest.approx(overall({"a": 0.5, "b": 0.11}))
    assert overall({"a": 0.55, "b": 0.1}, without="b") == pytest.approx(0.55)


def test_a_domain_that_came_later_does_not_count():
    assert overall({"a": 0.5, "views": 0.1}) == pytest.approx(0.5)

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import cv2
import numpy as np
import pytest

from placerec.datasets import LabelledImages, PlaceDataset
from placerec.errors import RecognizerError


@pytest.fixture
def recording(tmp_path, write_image):
    def make(name, labels, first_seed):
        everyone = np.arange(len(labels))
        return PlaceDataset(
            name=name,
            paths=tuple(
                write_image(tmp_path / name / f"{i}.png", seed=first_seed + i) for i in everyone
            ),
            queries=everyone,
            references=everyone,
            same_place=np.equal.outer(labels, labels),
            comparable=np.ones((len(labels),) * 2, bool),
            places=np.array(labels),
        )

    return make


def test_keeps_images_with_their_labels_and_datasets_apart(recording):
    first, second = recording("a", [0, 0, 3], 0), recording("b", [3, 0], 10)
    both = LabelledImages([first, second])
    np.testing.assert_array_equal(both.places, [0, 0, 1, 3, 2])
    assert len(both) == 5
    expected = [first[0], first[1], first[2], second[0], second[1]]
    for i, image in enumerate(expected):
        np.testing.assert_array_equal(both[i], image)


def test_dataset_without_labels_is_refused(recording):
    pairs_only = replace(recording("pairs", [0, 1], 0), places=None)
    with pytest.raises(RecognizerError, match=r"^pairs tells only which pairs") as caught:
        LabelledImages([recording("a", [0], 5), pairs_only])
    assert "\n" not in str(caught.value)


def test_same_image_twice_is_refused(recording):
    first = recording("a", [0, 1], 0)
    with pytest.raises(RecognizerError, match=r"^a and again have an image in common.*/a/\d\.png$"):
        LabelledImages([first, replace(first, name="again")])


def test_open_pairs_are_neither_the_same_nor_apart_and_datasets_are_apart(recording):
    first, second = recording("a", [0, 0, 1], 0), recording("b", [0, 1], 10)
    unknown = first.comparable.copy()
    unknown[1, 2] = unknown[2, 1] = False
    both = LabelledImages([replace(first, comparable=unknown), second])
    np.testing.assert_array_equal(both.scenes, [0, 0, 0, 1, 1])
    truth = both.pairs(np.array([3, 4, 1, 2, 0]))
    same = np.equal.outer([9, 8, 0, 1, 0], [9, 8, 0, 1, 0])
    np.testing.assert_array_equal(truth.same, same)
    apart = ~same
    apart[2, 3] = apart[3, 2] = False
    np.testing.assert_array_equal(truth.apart, apart)
    assert not truth.beyond.any()


def test_poses_say_which_pairs_are_the_same_whatever_labels_and_times_say(recording):
    posed = replace(
        recording("a", [0, 1, 1, 2], 0),
        comparable=np.zeros((4, 4), bool),  # all taken within moments
        positions_m=np.array([[0.0, 0, 0], [0.5, 0, 0], [0.9, 0, 0], [2.0, 0, 0]]),
        quaternions=np.tile([0.0, 0, 0, 1], (4, 1)),
    )
    truth = LabelledImages([posed]).pairs(np.arange(4))
    np.testing.assert_array_equal(
        truth.same, [[1, 1, 0, 0], [1, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 1]]
    )
    np.testing.assert_array_equal(truth.apart, ~truth.same)
    assert np.argwhere(truth.beyond).tolist() == [[0, 2], [2, 0]]


def test_collections_are_told_apart_and_spread_over_evenly(recording):
    few, many, more = (recording(n, [0] * k, 20 * k) for n, k in (("a", 3), ("b", 4), ("c", 5)))
    images = LabelledImages([few], [many, more])
    np.testing.assert_array_equal(images.collections, [0] * 3 + [1] * 9)
    np.testing.assert_array_equal(images.scenes, [0] * 3 + [1] * 4 + [2] * 5)
    assert images.spread(4).tolist() == [0, 2, 3, 11]
    assert images.spread(10).tolist() == [0, 1, 2, 3, 5, 7, 9, 11]  # there are no more of the first
    assert images.spread(99).tolist() == list(range(12))


def test_large_images_are_shrunk(tmp_path, recording):
    dataset = recording("a", [0, 1], 0)
    path = tmp_path / "large.png"
    assert cv2.imwrite(str(path), np.zeros((500, 800, 3), np.uint8))
    images = LabelledImages([replace(dataset, paths=(dataset.paths[0], path))])
    assert images[1].shape == (240, 384, 3)
    assert images[0].shape == dataset[0].shape

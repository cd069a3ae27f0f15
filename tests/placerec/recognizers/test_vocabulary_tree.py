# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.recognizers.bag_of_words import VocabularyTree, grow


def naive_word(tree, descriptor):
    """Descend as one would by hand: bits as text, one child after the other."""
    node = 0
    for level in tree.levels:
        bits = ["".join(f"{byte:08b}" for byte in child) for child in level[node]]
        own = "".join(f"{byte:08b}" for byte in descriptor)
        distances = [sum(a != b for a, b in zip(own, child, strict=True)) for child in bits]
        node = node * len(bits) + distances.index(min(distances))
    return node


def test_words_are_those_of_a_descent_by_hand():
    rng = np.random.default_rng(0)
    levels = tuple(rng.integers(0, 256, (3**depth, 3, 16), np.uint8) for depth in range(3))
    tree = VocabularyTree(levels)
    descriptors = rng.integers(0, 256, (50, 16), np.uint8)
    assert tree.words == 27
    assert tree(descriptors).tolist() == [naive_word(tree, each) for each in descriptors]
    assert tree(descriptors[:0]).shape == (0,)


def test_many_descriptors_are_as_few(monkeypatch):
    rng = np.random.default_rng(1)
    descriptors = rng.integers(0, 256, (40, 8), np.uint8)
    whole = grow(descriptors, 3, 2, np.random.default_rng(0))
    words = whole(descriptors)
    monkeypatch.setattr("placerec.recognizers.bag_of_words.CHUNK", 7)
    parts = grow(descriptors, 3, 2, np.random.default_rng(0))
    for level, other in zip(whole.levels, parts.levels, strict=True):
        np.testing.assert_array_equal(level, other)
    np.testing.assert_array_equal(parts(descriptors), words)


@pytest.mark.parametrize("seed", range(3))
def test_what_lies_together_is_one_word(seed):
    rng = np.random.default_rng(seed)
    # Two far from two others, and not near to each other; one bit varies within each.
    middles = np.repeat(np.array([[0], [3], [252], [255]], np.uint8), 32, axis=1)
    groups = np.repeat(middles, 30, axis=0)
    groups[:, 0] ^= rng.integers(0, 2, len(groups), np.uint8)
    tree = grow(groups, 2, 2, rng)
    words = tree(groups).reshape(4, 30)
    assert (words == words[:, :1]).all()
    assert len(set(words[:, 0])) == 4


def test_a_middle_has_the_bits_of_most():
    descriptors = np.array([[7] * 8, [5] * 8, [5] * 8, [4] * 8], np.uint8)
    tree = grow(descriptors, 1, 1, np.random.default_rng(0))
    np.testing.assert_array_equal(tree.levels[0], [[[5] * 8]])


def test_fewer_descriptors_than_words_leave_words_that_are_never_seen():
    descriptors = np.repeat(np.array([[1], [254]], np.uint8), 8, axis=1)
    tree = grow(descriptors, 4, 2, np.random.default_rng(0))
    assert tree.words == 16
    assert len(set(tree(descriptors).tolist())) == 2
    assert set(tree(np.random.default_rng(0).integers(0, 256, (99, 8), np.uint8)).tolist()) == set(
        tree(descriptors).tolist()
    )


def test_the_same_seed_grows_the_same_tree():
    descriptors = np.random.default_rng(0).integers(0, 256, (200, 32), np.uint8)
    first, again, other = (grow(descriptors, 4, 2, np.random.default_rng(s)) for s in (5, 5, 6))
    for level, same in zip(first.levels, again.levels, strict=True):
        np.testing.assert_array_equal(level, same)
    assert any(
        not np.array_equal(level, differs)
        for level, differs in zip(first.levels, other.levels, strict=True)
    )

# SPDX-License-Identifier: Apache-2.0
import math
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from placerec.certificate import certificate_of
from placerec.conformance import check
from placerec.errors import RecognizerError
from placerec.recognizer import load
from placerec.recognizers import bag_of_words
from placerec.recognizers.bag_of_words import BagOfWords, VocabularyTree, grow
from placerec.recognizers.fitted_file import Fitted, read_fitted, shipped, write_fitted


def picture(seed, blocks=20):
    small = np.random.default_rng(seed).integers(0, 256, (blocks, blocks, 3), np.uint8)
    return cv2.resize(small, (320, 240), interpolation=cv2.INTER_NEAREST)


@pytest.fixture(scope="module")
def recognizer():
    return BagOfWords()


def test_conforms(recognizer):
    report = check(recognizer)
    assert report.passed, str(report)


@pytest.fixture
def two_words(tmp_path):
    """Write a vocabulary of two words, all bits unset or set, of which the second is rarer."""
    level = np.repeat(np.array([[[0], [255]]], np.uint8), 32, axis=2)
    path = tmp_path / "two.safetensors"
    rarity = np.array([1.0, 3.0], np.float32)
    write_fitted(path, "bag-of-words", Fitted({"level0": level, "rarity": rarity}))
    return path


def test_an_embedding_by_hand(two_words, monkeypatch):
    # Three descriptors of the first word, two of the second: 3 * 1 and 2 * 3, of 9 in all.
    seen = np.repeat(np.array([[0], [1], [3], [255], [127]], np.uint8), 32, axis=1)
    monkeypatch.setattr(bag_of_words, "_descriptors", lambda image: seen)
    embedding = BagOfWords(two_words).embed(picture(0))
    np.testing.assert_allclose(embedding, [3 / 9, 6 / 9, 0], rtol=1e-6)


def test_the_score_is_that_of_dbow2(recognizer):
    rng = np.random.default_rng(0)
    vectors = rng.random((7, 30)) * (rng.random((7, 30)) < 0.4) + 1e-3 * np.eye(7, 30)
    shares = (vectors / vectors.sum(axis=1, keepdims=True)).astype(np.float32)
    scores = [[1.0 - 0.5 * np.abs(v - w).sum() for w in shares[2:]] for v in shares[:3]]
    compared = recognizer.compare(shares[:3], shares[2:])
    np.testing.assert_allclose(compared, scores, atol=1e-6)
    assert compared.dtype == np.float32 and compared[2, 0] == pytest.approx(1.0)


def test_vectors_of_unit_length_kept_from_before_are_not_taken_for_these(recognizer):
    learned = read_fitted(shipped("bag-of-words"), "bag-of-words")
    assert recognizer.fingerprint != learned.fingerprint


def test_an_image_in_which_no_word_is_seen_is_unlike_all_others(two_words):
    blank = BagOfWords(two_words).embed(np.full((48, 64, 3), 90, np.uint8))
    np.testing.assert_array_equal(blank, [0, 0, 1])


def test_rarity_by_hand(tmp_path, monkeypatch):
    # Of three images all show the first descriptor, one the second; the third is seen in none.
    a, b = np.zeros((1, 32), np.uint8), np.full((1, 32), 255, np.uint8)
    documents = iter([a, np.concatenate([a, a]), np.concatenate([a, b, b])])
    monkeypatch.setattr(bag_of_words, "_descriptors", lambda image: next(documents))
    monkeypatch.setattr(bag_of_words, "CHILDREN", 2)
    monkeypatch.setattr(bag_of_words, "DEPTH", 1)
    arrays = BagOfWords.fit([picture(0)] * 3).arrays
    words = [int(VocabularyTree((arrays["level0"],))(each)[0]) for each in (a, b)]
    expected = [math.log(4 / 4), math.log(4 / 2)]
    np.testing.assert_allclose(arrays["rarity"][words], expected, rtol=1e-6)


def test_what_was_learned_is_used_and_the_seed_decides(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_of_words, "CHILDREN", 3)
    images = [picture(seed) for seed in range(3)]
    learned, again, other = (BagOfWords.fit(images, seed) for seed in (4, 4, 5))
    assert learned.fingerprint == again.fingerprint != other.fingerprint
    path = tmp_path / "w.safetensors"
    write_fitted(path, "bag-of-words", replace(learned, trained_on=("walk",), min_similarity=0.3))
    recognizer = load(str(path))
    assert isinstance(recognizer, BagOfWords)
    assert recognizer.fingerprint.endswith(learned.fingerprint)
    assert recognizer.min_similarity == 0.3
    assert recognizer.trained_on == ("walk",) and recognizer.weights == "27 words of walk"
    assert recognizer.embed(images[0]).shape == (28,)


def test_images_without_a_corner_teach_nothing():
    with pytest.raises(RecognizerError, match="no corner was found in 2 images"):
        BagOfWords.fit([np.zeros((48, 64, 3), np.uint8)] * 2)


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 500, 3), (481, 3, 3)])
def test_images_of_any_size(recognizer, shape):
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    assert recognizer.embed(image).sum() == pytest.approx(1.0, abs=1e-5)


def test_the_shipped_vocabulary_is_small_and_comes_with_its_certificate(recognizer):
    assert shipped("bag-of-words").stat().st_size < 1 << 20
    assert recognizer.trained_on == ("ie_tower:train",)
    certificate = certificate_of(recognizer)
    assert len(certificate.kinds) == 4 and "ie_tower:validation" in certificate.data
    assert certificate.min_similarity == recognizer.min_similarity


def test_it_needs_no_torch():
    code = (
        "import sys; from placerec.recognizers.bag_of_words import BagOfWords; BagOfWords(); "
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


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
    monkeypatch.setattr(bag_of_words, "CHUNK", 7)
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

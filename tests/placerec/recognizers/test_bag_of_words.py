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
from placerec.recognizers.bag_of_words import SHIPPED, BagOfWords, VocabularyTree
from placerec.recognizers.fitted_file import Fitted, write_fitted


def picture(seed, blocks=20):
    small = np.random.default_rng(seed).integers(0, 256, (blocks, blocks, 3), np.uint8)
    return cv2.resize(small, (320, 240), interpolation=cv2.INTER_NEAREST)


@pytest.fixture(scope="module")
def recognizer():
    return BagOfWords()


def test_conforms(recognizer):
    report = check(recognizer)
    assert report.passed, report


@pytest.fixture
def two_words(tmp_path):
    """Write a vocabulary of two words, all bits unset or set, of which the second is rarer."""
    level = np.repeat(np.array([[[0], [255]]], np.uint8), 32, axis=2)
    path = tmp_path / "two.safetensors"
    rarity = np.array([1.0, 3.0], np.float32)
    write_fitted(path, "bag-of-words", Fitted({"level0": level, "rarity": rarity}))
    return path


def test_an_embedding_by_hand(two_words, monkeypatch):
    # Three descriptors of the first word, two of the second: (3 * 1, 2 * 3) on the unit circle.
    seen = np.repeat(np.array([[0], [1], [3], [255], [127]], np.uint8), 32, axis=1)
    monkeypatch.setattr(bag_of_words, "_descriptors", lambda image: seen)
    embedding = BagOfWords(two_words).embed(picture(0))
    np.testing.assert_allclose(embedding, [3 / math.sqrt(45), 6 / math.sqrt(45), 0], rtol=1e-6)


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
    assert (recognizer.fingerprint, recognizer.min_similarity) == (learned.fingerprint, 0.3)
    assert recognizer.trained_on == ("walk",) and recognizer.weights == "27 words of walk"
    assert recognizer.embed(images[0]).shape == (28,)


def test_images_without_a_corner_teach_nothing():
    with pytest.raises(RecognizerError, match="no corner was found in 2 images"):
        BagOfWords.fit([np.zeros((48, 64, 3), np.uint8)] * 2)


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 500, 3), (481, 3, 3)])
def test_images_of_any_size(recognizer, shape):
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    assert np.linalg.norm(recognizer.embed(image)) == pytest.approx(1.0, abs=1e-5)


def test_the_shipped_vocabulary_is_small_and_comes_with_its_certificate(recognizer):
    assert SHIPPED.stat().st_size < 1 << 20
    assert recognizer.trained_on == ("ie_tower:train",)
    certificate = certificate_of(recognizer)
    assert certificate.data == "ie_tower:validation"
    assert certificate.min_similarity == recognizer.min_similarity


def test_it_needs_no_torch():
    code = (
        "import sys; from placerec.recognizers.bag_of_words import BagOfWords; BagOfWords(); "
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

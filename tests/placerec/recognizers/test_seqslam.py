# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys

import numpy as np
import pytest

from placerec.checked_recognizer import CheckedRecognizer
from placerec.conformance import check
from placerec.places.index import PlaceIndex
from placerec.recognizers.seqslam import SeqSlam, Thumbnails, stand_out


def unit_rows(seed, count, dimension=16):
    rows = np.random.default_rng(seed).normal(size=(count, dimension))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def naive_contrast(similarities):
    result = np.zeros(similarities.shape)
    for i, row in enumerate(similarities.astype(float)):
        for j, value in enumerate(row):
            around = row[max(0, j - 5) : j + 6]
            if around.std() > 1e-6:
                result[i, j] = (value - around.mean()) / around.std() / np.sqrt(len(around) - 1)
    return result


def naive_compare(queries, references):
    """Search every path through the matrix of contrasts, one number at a time."""
    contrast = naive_contrast(np.clip(queries @ references.T, -1, 1))
    result = np.zeros(contrast.shape)
    for i in range(len(queries)):
        for j in range(len(references)):
            sums = []
            for speed in (0.8, 0.9, 1.0, 1.1, 1.2, -0.8, -0.9, -1.0, -1.1, -1.2):
                steps = [(i - k, j - round(speed * k)) for k in range(min(10, i + 1))]
                inside = [contrast[a, b] for a, b in steps if 0 <= b < len(references)]
                sums.append(sum(inside) / 10)
            result[i, j] = max(sums)
    return result


@pytest.mark.parametrize(("queries", "references"), [(14, 30), (3, 7), (12, 1), (1, 12)])
def test_similarities_are_those_of_a_search_by_hand(queries, references):
    rows, columns = unit_rows(0, queries), unit_rows(1, references)
    found = SeqSlam().compare(rows, columns)
    np.testing.assert_allclose(found, naive_compare(rows, columns), atol=1e-5)
    assert found.dtype == np.float32 and np.abs(found).max() <= 1.0


def test_contrast_by_hand():
    # Eleven neighbours, one of which stands out as far as one of eleven can.
    similarities = np.full((1, 20), 0.5, np.float32)
    similarities[0, 10] = 0.9
    contrast = stand_out(similarities)
    assert contrast[0, 10] == pytest.approx(1.0)
    assert contrast[0, 9] == pytest.approx(-0.1)
    assert contrast[0, 4] == 0.0  # its neighbours end before the odd one
    assert (stand_out(np.full((2, 30), 0.25, np.float32)) == 0.0).all()


@pytest.mark.parametrize("step", [1, -1])
def test_a_way_is_told_where_single_images_are_not_whichever_way_it_is_gone(step):
    # Each query is nearly as like a wrong reference as the right one: alone some of them go wrong.
    references = unit_rows(2, 60)
    way = np.arange(20, 32)[::step]
    noise = unit_rows(3, len(way))
    queries = references[way] + 1.3 * noise
    queries = (queries / np.linalg.norm(queries, axis=1, keepdims=True)).astype(np.float32)
    alone = (queries @ references.T).argmax(axis=1)
    together = SeqSlam().compare(queries, references).argmax(axis=1)
    assert (alone == way).mean() < 0.8
    assert (together[6:] == way[6:]).all()


def test_in_a_map_the_last_images_come_along():
    rows = unit_rows(4, 40)
    recognizer = CheckedRecognizer(SeqSlam())
    index = PlaceIndex(recognizer)
    for row in rows[:-1]:
        index.add(row)
    ids, similarities = index.query(rows[-1], count=25, among=np.arange(39) < 25)
    whole = naive_compare(rows, rows[:25])[-1]
    np.testing.assert_allclose(similarities, np.sort(whole)[::-1], atol=1e-5)
    np.testing.assert_allclose(whole[ids], similarities, atol=1e-5)


def test_a_thumbnail_by_hand():
    # Every patch half black, half white, whatever its brightness: all values are -1 or +1.
    image = np.zeros((32, 64, 3), np.uint8)
    image[:, ::2] = 100
    image[:, 32:] //= 2
    embedding = Thumbnails().embed(image)
    assert embedding.shape == (32 * 64 + 1,)
    np.testing.assert_allclose(np.abs(embedding[:-1]), 1 / np.sqrt(32 * 64), rtol=1e-5)
    assert embedding[-1] == 0.0


def test_brightness_and_contrast_of_a_patch_do_not_count():
    image = np.random.default_rng(0).integers(0, 100, (32, 64, 3), np.uint8)
    # By one colour only, so that rounding to grey does not change.
    image[...] = image[..., :1]
    brighter = image.copy()
    brighter[8:16, 16:24] = 2 * brighter[8:16, 16:24] + 30
    np.testing.assert_allclose(Thumbnails().embed(brighter), Thumbnails().embed(image), atol=1e-6)


def test_conforms():
    report = check(SeqSlam())
    assert report.passed, str(report)


class Constant:
    min_similarity = 0.3
    fingerprint, weights, trained_on = "mine", "a thing", ("walk",)

    def embed(self, image):
        return np.array([1.0, 2.0], np.float32)

    def compare(self, queries, references):
        return np.minimum(queries[:, None, 0], references[None, :, 0])


def test_any_recognizer_can_be_wrapped_with_its_own_way_to_compare():
    wrapped = SeqSlam(Constant())
    assert wrapped.embed(np.zeros((2, 2, 3), np.uint8)).tolist() == [1.0, 2.0]
    values = np.random.default_rng(0).random((12, 2)).astype(np.float32)
    alone = Constant().compare(values[-1:], values)
    np.testing.assert_allclose(
        wrapped.compare(values[-1:], values), naive_contrast(alone) / 10, atol=1e-5
    )
    assert wrapped.weights == "sequences of 10: a thing"
    assert (wrapped.fingerprint, wrapped.trained_on) == ("mine", ("walk",))


def test_it_needs_no_torch():
    code = "import sys, placerec.recognizers.seqslam; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from placerec.certificate import certificate_of
from placerec.conformance import check
from placerec.errors import RecognizerError
from placerec.recognizers.fitted_file import write_fitted
from placerec.recognizers.r_mac import (
    EVENNESS,
    RMac,
    pooled_regions,
    principal_components,
    regions_of,
)


@pytest.fixture
def recognizer(weights, photographs, tmp_path):
    path = tmp_path / "whitening.safetensors"
    write_fitted(path, "r-mac", replace(RMac.fit(photographs), trained_on=("boards",)))
    return RMac(path)


def test_regions_of_square_maps_are_those_of_the_paper():
    found = regions_of(12, 12)
    assert found[0] == (0, 0, 12)
    assert found[1:5] == [(0, 0, 8), (0, 4, 8), (4, 0, 8), (4, 4, 8)]
    assert found[5:] == [(y, x, 6) for y in (0, 3, 6) for x in (0, 3, 6)]


def test_regions_of_longer_maps_overlap_by_two_fifths_and_lie_within():
    # Two squares of 10 in 16 overlap by 0.4; at the next scales one more along the longer side.
    assert [region for region in regions_of(10, 16) if region[2] == 10] == [(0, 0, 10), (0, 6, 10)]
    assert [sum(side == s for *_, side in regions_of(10, 16)) for s in (10, 6, 5)] == [2, 6, 12]
    for height, width in ((10, 16), (16, 10), (5, 6), (14, 14), (3, 9), (1, 1), (1, 5)):
        for y, x, side in regions_of(height, width):
            assert 0 <= y <= y + side <= height
            assert 0 <= x <= x + side <= width
        turned = sorted((x, y, side) for y, x, side in regions_of(width, height))
        assert turned == sorted(regions_of(height, width))


def test_a_region_is_the_maximum_of_each_channel():
    maps = np.random.default_rng(0).normal(size=(7, 9, 12)).astype(np.float32)
    for row, (y, x, side) in zip(pooled_regions(maps), regions_of(9, 12), strict=True):
        naive = [
            max(maps[c, i, j] for i in range(y, y + side) for j in range(x, x + side))
            for c in range(7)
        ]
        assert row == pytest.approx(np.array(naive) / np.linalg.norm(naive), abs=1e-6)


def test_whitened_rows_have_no_mean_and_strong_directions_vary_alike():
    rng = np.random.default_rng(1)
    rows = (rng.normal(size=(4000, 5)) * [5, 3, 2, 1, 0.5] @ rng.normal(size=(5, 5)) + 7).astype(
        np.float32
    )
    mean, whitening = principal_components(rows)
    white = (rows - mean) @ whitening.T
    assert white.mean(axis=0) == pytest.approx(np.zeros(5), abs=1e-3)
    covariance = white.T @ white / len(white)
    assert covariance == pytest.approx(np.diag(np.diag(covariance)), abs=1e-3)
    variances = np.linalg.svd(rows - mean, compute_uv=False) ** 2 / len(rows)
    expected = variances / (variances + EVENNESS * variances.mean())  # 1 but for faint ones
    assert np.diag(covariance) == pytest.approx(expected, abs=1e-3)


def naive_similarity(query, reference):
    """Return the sum of cosines of regions that are each other's best, over their number."""
    total = 0.0
    for i, region in enumerate(query):
        j = int(np.argmax([region @ other for other in reference]))
        back = int(np.argmax([reference[j] @ other for other in query]))
        total += float(region @ reference[j]) if back == i else 0.0
    return total / len(query)


def test_comparing_agrees_with_matching_region_by_region(recognizer):
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(9, 14, 16)) + 2 * rng.normal(size=(9, 1, 16))
    rows = (rows / np.linalg.norm(rows, axis=2, keepdims=True)).astype(np.float32)
    found = recognizer.compare(rows[:4], rows)
    naive = [[naive_similarity(query, reference) for reference in rows] for query in rows[:4]]
    assert found == pytest.approx(np.array(naive), abs=1e-5)
    assert found.diagonal() == pytest.approx(np.ones(4))


def test_two_regions_by_hand(recognizer):
    query = np.float32([[[1, 0], [0.6, 0.8]]])
    reference = np.float32([[[1, 0], [0, 1]]])
    # 1st with 1st: cosine 1. 2nd of the query is best with 2nd of the reference: 0.8, and back.
    assert recognizer.compare(query, reference) == pytest.approx(np.array([[0.9]]))
    # Both of the query are nearest to the same region, which is nearest to the first of them.
    reference = np.float32([[[1, 0], [-1, 0]]])
    assert recognizer.compare(query, reference) == pytest.approx(np.array([[0.5]]))


def test_an_image_of_one_colour_is_like_itself(recognizer):
    black = recognizer.embed(np.zeros((60, 80, 3), np.uint8))
    assert recognizer.compare(black[None], black[None]) == pytest.approx(np.ones((1, 1)))


def test_it_conforms_but_for_what_random_filters_make_of_images(recognizer):
    failed = {one.check.name for one in check(recognizer).findings if one.failed}
    of_filters = {"darker and brighter", "shifted by 16 pixels"}
    assert failed <= {*of_filters, "min_similarity keeps others out"}


def test_what_is_shipped_comes_with_its_certificate(real_weights):
    recognizer = RMac()
    assert certificate_of(recognizer).min_similarity == recognizer.min_similarity


def test_it_says_what_it_runs_on_and_what_it_needs(recognizer, machine, monkeypatch):
    assert recognizer.weights.startswith("mobilenet_v2 block16 at")
    assert recognizer.weights.endswith("whitened on boards")
    monkeypatch.delenv("LOOPCLOSE_WEIGHTS")
    with pytest.raises(RecognizerError, match="begins with mobilenet_v2 "):
        RMac()

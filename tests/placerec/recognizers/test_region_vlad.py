# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from placerec.certificate import certificate_of
from placerec.conformance import check
from placerec.errors import RecognizerError
from placerec.recognizers import region_vlad
from placerec.recognizers.fitted_file import read_fitted, shipped, write_fitted
from placerec.recognizers.region_vlad import RegionVlad, residuals, salient_regions


@pytest.fixture
def recognizer(weights, photographs, tmp_path, monkeypatch):
    monkeypatch.setattr(region_vlad, "WORDS", 16)
    path = tmp_path / "words.safetensors"
    fitted = replace(RegionVlad.fit(photographs[:6]), trained_on=("boards",))
    write_fitted(path, "region-vlad", fitted)
    return RegionVlad(path)


def naive_regions(maps, count):
    """Grow regions cell by cell, describe each one by one."""
    found = []
    for channel in maps:
        free = {(int(y), int(x)) for y, x in zip(*np.nonzero(channel > 0), strict=True)}
        while free:
            region, edge = set(), [min(free)]
            while edge:
                y, x = edge.pop()
                if (y, x) in free:
                    free.remove((y, x))
                    region.add((y, x))
                    edge += [(y + i, x + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
            mean = sum(channel[cell] for cell in region) / len(region)
            sums = sum(maps[:, y, x].astype(float) for y, x in region)
            found.append((mean, sums / np.linalg.norm(sums)))
    found.sort(key=lambda region: -region[0])
    return np.array([sums for _, sums in found[:count]])


def test_regions_are_those_found_by_hand():
    rng = np.random.default_rng(0)
    maps = np.maximum(rng.normal(size=(5, 9, 7)) - 0.6, 0.0).astype(np.float32)
    for count in (3, 12, 1000):
        expected = naive_regions(maps, count)
        np.testing.assert_allclose(salient_regions(maps, count), expected, atol=1e-5)
    assert 12 < len(expected) < 1000


def test_a_tiny_case():
    # Two channels; the first has a corner cell that touches nothing and a pair that touches
    # diagonally, the second one cell.
    maps = np.zeros((2, 3, 3), np.float32)
    maps[0, 0, 0] = 1.0
    maps[0, 1, 2] = maps[0, 2, 1] = 3.0
    maps[1, 2, 1] = 8.0
    # By mean: (3 of the second, seen with 8), then the pair (6, 8), then the corner (1, 0).
    expected = [[3 / np.hypot(3, 8), 8 / np.hypot(3, 8)], [0.6, 0.8], [1.0, 0.0]]
    np.testing.assert_allclose(salient_regions(maps), expected, atol=1e-6)


def test_residuals_by_hand():
    words = np.array([[1.0, 0.0], [0.0, 0.5]], np.float32)
    regions = np.array([[0.6, 0.8], [0.8, 0.6], [1.0, 0.0]], np.float32)
    # Squared distances to the words: (0.8, 0.45), (0.4, 0.65), (0, 1.25).
    first = np.array([0.8 - 1.0, 0.6])
    second = np.array([0.6, 0.8 - 0.5])
    rows = [first / np.linalg.norm(first), second / np.linalg.norm(second)]
    expected = np.concatenate(rows) / np.sqrt(2)
    np.testing.assert_allclose(residuals(regions, words), expected, atol=1e-6)


def test_it_conforms(recognizer):
    report = check(recognizer)
    assert report.passed, str(report)


def test_what_is_shipped_conforms(real_weights):
    recognizer = RegionVlad()
    assert certificate_of(recognizer).min_similarity == recognizer.min_similarity
    report = check(recognizer)
    assert report.passed, str(report)


def test_nothing_above_zero_is_an_embedding_too(recognizer, monkeypatch):
    monkeypatch.setattr(recognizer, "_maps", lambda image: np.full((256, 4, 4), -1, np.float32))
    assert np.linalg.norm(recognizer.embed(np.zeros((9, 9, 3), np.uint8))) == pytest.approx(1.0)


def test_it_says_what_it_runs_on(recognizer, photographs):
    assert recognizer.weights == (
        "squeezenet fire5 at 227x227 px, published weights squeezenet_1.0.npz; 16 words of boards"
    )
    assert recognizer.trained_on == ("boards",)
    assert recognizer.embed(photographs[0]).shape == (16 * 256,)


def test_the_seed_decides(weights, photographs, monkeypatch):
    monkeypatch.setattr(region_vlad, "WORDS", 16)
    first, again, other = (RegionVlad.fit(photographs[:3], seed) for seed in (1, 1, 2))
    assert first.fingerprint == again.fingerprint != other.fingerprint


def test_without_weights_it_says_what_to_do(recognizer, monkeypatch):
    monkeypatch.delenv("LOOPCLOSE_WEIGHTS")
    with pytest.raises(RecognizerError, match="LOOPCLOSE_WEIGHTS"):
        RegionVlad()


def test_too_few_images_are_refused(weights, photographs, monkeypatch):
    monkeypatch.setattr(region_vlad, "WORDS", 10000)
    with pytest.raises(RecognizerError, match="10000 words cannot be found"):
        RegionVlad.fit(photographs[:1])


def test_what_comes_with_the_package_is_small_and_fits_the_layer():
    path = shipped("region-vlad")
    assert path.stat().st_size < 1 << 20
    assert read_fitted(path, "region-vlad").arrays["words"].shape == (256, 256)

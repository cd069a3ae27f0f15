# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec.certificate import fingerprint
from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation import bootstrap, calibration
from placerec.evaluation.calibration import calibrate
from placerec.evaluation.precision_recall import compare
from placerec.recognizers.gradients import GradientRecognizer


@pytest.fixture
def dataset():
    """Twelve places of four images each, compared with each other."""
    places = np.repeat(np.arange(12), 4)
    everyone = np.arange(48)
    return PlaceDataset(
        name="twelve places",
        paths=tuple(Path(f"{i}.png") for i in range(48)),
        queries=everyone,
        references=everyone,
        same_place=places[:, None] == places,
        comparable=~np.eye(48, dtype=bool),
        places=places,
    )


@pytest.fixture
def embeddings(dataset):
    """Return a noisy direction per place: most, but not all, same places are more similar."""
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(12, 6))[dataset.places] + 0.4 * rng.normal(size=(48, 6))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture
def certificate(dataset, embeddings):
    return calibrate("gradients", GradientRecognizer(), dataset, embeddings)


def pairs_of(dataset, embeddings):
    similarities = compare(embeddings, dataset)[dataset.pairs]
    return similarities, dataset.same_place[dataset.pairs]


class Halves(GradientRecognizer):
    """Calls everything half as similar as its cosine says."""

    def compare(self, queries, references):
        return queries @ references.T / 2


def test_similarities_are_those_of_the_recognizer(certificate, dataset, embeddings):
    halved = calibrate("halves", Halves(), dataset, embeddings)
    assert halved.threshold == pytest.approx(certificate.threshold / 2)
    assert halved.min_similarity == pytest.approx(certificate.min_similarity / 2)


def test_threshold_is_free_of_errors_and_no_lower_one_recalls_more(
    certificate, dataset, embeddings
):
    similarities, right = pairs_of(dataset, embeddings)
    accepted = similarities >= certificate.threshold
    assert right[accepted].all()
    assert certificate.recall == pytest.approx(accepted.sum() / right.sum())
    assert 0.1 < certificate.recall < 1.0
    assert certificate.highest_wrong == pytest.approx(similarities[~right].max())
    more = right & (similarities > certificate.highest_wrong)
    assert more.sum() == accepted.sum()


def test_certificate_says_on_what(certificate):
    assert certificate.recognizer == "gradients"
    assert certificate.fingerprint == fingerprint(GradientRecognizer())
    assert certificate.data == "twelve places"
    assert (certificate.images, certificate.skipped) == (48, 0)
    assert (certificate.pairs, certificate.same_place_pairs) == (48 * 47 // 2, 12 * 6)
    assert certificate.resampled == "places"


def test_curve_holds_the_threshold_and_ends_with_all_recalled(certificate):
    at = [point for point in certificate.curve if point[0] == certificate.threshold]
    assert at == [(certificate.threshold, 1.0, pytest.approx(certificate.recall))]
    assert certificate.curve[-1][2] == 1.0
    thresholds = [point[0] for point in certificate.curve]
    assert thresholds == sorted(thresholds, reverse=True)


def test_long_curve_is_thinned_out(dataset, embeddings, monkeypatch):
    monkeypatch.setattr(calibration, "_CURVE_POINTS", 10)
    certificate = calibrate("gradients", GradientRecognizer(), dataset, embeddings)
    assert 10 <= len(certificate.curve) <= 11
    assert certificate.threshold in [point[0] for point in certificate.curve]


def test_same_seed_same_certificate(certificate, dataset, embeddings):
    again = calibrate("gradients", GradientRecognizer(), dataset, embeddings)
    other = calibrate("gradients", GradientRecognizer(), dataset, embeddings, seed=1)
    assert again == certificate
    assert other.threshold == certificate.threshold
    assert other.threshold_interval != certificate.threshold_interval


def naive_resample(dataset, embeddings, images):
    """Return threshold (None where there is none) and recall of images drawn with repetition."""
    similarities = compare(embeddings, dataset)
    chosen = [
        (similarities[i, j], dataset.same_place[i, j])
        for a, i in enumerate(images)
        for j in images[:a]
        if dataset.comparable[i, j]
    ]
    wrong = max((s for s, right in chosen if not right), default=-np.inf)
    right = [s for s, right in chosen if right]
    above = [s for s in right if s > wrong]
    return min(above, default=None), len(above) / max(1, len(right))


def signs_of_twelve_places():
    """Return embeddings of which some right and the most similar wrong pairs are at 0.75."""
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (12, 16)).repeat(4, axis=0)
    for image in range(48):
        if image % 4:
            signs[image, image % 4] *= -1.0
    return (signs / 4.0).astype(np.float32)


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("tied", [True, False])
def test_intervals_agree_with_a_naive_bootstrap(dataset, embeddings, monkeypatch, labelled, tied):
    monkeypatch.setattr(bootstrap, "RESAMPLES", 20)
    monkeypatch.setattr(calibration, "_BLOCK", 7)
    if tied:
        embeddings = signs_of_twelve_places()
    if not labelled:
        dataset = replace(dataset, places=None)
    certificate = calibrate("gradients", GradientRecognizer(), dataset, embeddings, seed=3)
    rng = np.random.default_rng(3)
    drawn = []
    for _ in range(20):
        if labelled:
            images = [
                i for place in rng.integers(12, size=12) for i in range(4 * place, 4 * place + 4)
            ]
        else:
            images = rng.integers(48, size=48).tolist()
        drawn.append(naive_resample(dataset, embeddings, images))
    thresholds = [threshold for threshold, _ in drawn if threshold is not None]
    assert certificate.resampled == ("places" if labelled else "images")
    assert certificate.without_threshold == 20 - len(thresholds)
    assert np.allclose(certificate.threshold_interval, np.quantile(thresholds, [0.025, 0.975]))
    assert np.allclose(
        certificate.recall_interval, np.quantile([recall for _, recall in drawn], [0.025, 0.975])
    )


def test_intervals_hold_what_they_are_about(certificate):
    low, high = certificate.threshold_interval
    assert low <= certificate.threshold <= high
    low, high = certificate.recall_interval
    assert low < certificate.recall < high


def test_ranges_leave_out_the_extremes_of_either_kind(certificate, dataset, embeddings):
    similarities, right = pairs_of(dataset, embeddings)
    for kind, (low, high) in (
        (similarities[~right], certificate.different_places),
        (similarities[right], certificate.same_place),
    ):
        assert (kind < low).mean() == pytest.approx(0.01, abs=0.01)
        assert (kind > high).mean() == pytest.approx(0.01, abs=0.01)


def test_one_in_a_hundred_pairs_of_different_places_is_worth_verifying(
    certificate, dataset, embeddings
):
    similarities, right = pairs_of(dataset, embeddings)
    passing = similarities >= certificate.min_similarity
    assert passing[~right].mean() == pytest.approx(0.01, abs=0.001)
    assert passing[right].mean() == pytest.approx(certificate.recall_to_verify)
    assert certificate.min_similarity < certificate.threshold
    assert certificate.recall_to_verify > certificate.recall


def test_queries_and_references_of_two_drives(dataset, embeddings):
    queries, references = np.arange(0, 48, 2), np.arange(1, 48, 2)
    drives = replace(
        dataset,
        queries=queries,
        references=references,
        same_place=dataset.same_place[np.ix_(queries, references)],
        comparable=np.ones((24, 24), bool),
    )
    certificate = calibrate("gradients", GradientRecognizer(), drives, embeddings)
    assert certificate.pairs == 24 * 24
    assert certificate.same_place_pairs == 12 * 4


def test_error_at_the_top_leaves_no_threshold_and_names_the_pair(dataset, embeddings):
    embeddings = embeddings.copy()
    embeddings[40] = embeddings[3]
    with pytest.raises(RecognizerError, match=r"^no threshold keeps thumbs .* 3\.png and 40\.png$"):
        calibrate("thumbs", GradientRecognizer(), dataset, embeddings)

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec.certificate import fingerprint
from placerec.datasets import PlaceDataset
from placerec.evaluation import bootstrap
from placerec.evaluation.calibration import Scenes, calibrate
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
def scenes(dataset, embeddings):
    return Scenes("twelve places", [dataset], [embeddings])


@pytest.fixture
def certificate(scenes):
    return calibrate("gradients", GradientRecognizer(), [scenes])


def pairs_of(dataset, embeddings):
    """Return the similarities of pairs of one place, and of different ones."""
    similarities = compare(embeddings, dataset)[dataset.pairs].astype(float)
    right = dataset.same_place[dataset.pairs]
    return similarities[right], similarities[~right]


class Halves(GradientRecognizer):
    """Calls everything half as similar as its cosine says."""

    def compare(self, queries, references):
        return queries @ references.T / 2


@pytest.fixture
def alike(dataset, embeddings):
    """Return a kind of scene in which all images have much in common."""
    rows = embeddings + np.array([1.0, 0, 0, 0, 0, 0], np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return Scenes("all alike", [dataset], [rows])


def test_similarities_are_those_of_the_recognizer(certificate, scenes):
    halved = calibrate("halves", Halves(), [scenes])
    assert halved.threshold == pytest.approx(certificate.threshold / 2)
    assert halved.min_similarity == pytest.approx(certificate.min_similarity / 2)


def test_certificate_says_on_what(certificate):
    assert certificate.recognizer == "gradients"
    assert certificate.fingerprint == fingerprint(GradientRecognizer())
    (kind,) = certificate.kinds
    assert kind.data == certificate.data == "twelve places"
    assert (kind.images, kind.skipped) == (48, 0)
    assert (kind.pairs, kind.same_place_pairs) == (48 * 47 // 2, 12 * 6)
    assert kind.resampled == "places"
    assert kind.left_out_to_verify is None and kind.left_out_tau is None


def test_thresholds_are_reached_by_one_in_a_hundred_and_one_in_a_thousand(
    certificate, dataset, embeddings
):
    right, wrong = pairs_of(dataset, embeddings)
    assert (wrong >= certificate.min_similarity).mean() == pytest.approx(0.01, abs=0.001)
    assert (wrong >= certificate.threshold).mean() == pytest.approx(0.001, abs=0.001)
    assert certificate.recall_to_verify == (right >= certificate.min_similarity).mean()
    assert certificate.recall == (right >= certificate.threshold).mean()
    assert certificate.min_similarity < certificate.threshold
    assert certificate.recall_to_verify > certificate.recall > 0.1


def test_one_wrong_label_decides_nothing(certificate, dataset, embeddings):
    similarities = np.where(dataset.pairs, compare(embeddings, dataset), -1.0)
    top = np.unravel_index(similarities.argmax(), similarities.shape)
    same_place = dataset.same_place.copy()
    same_place[top] = same_place[top[::-1]] = False
    scenes = Scenes("mistaken", [replace(dataset, same_place=same_place)], [embeddings])
    mistaken = calibrate("gradients", GradientRecognizer(), [scenes])
    assert mistaken.min_similarity == pytest.approx(certificate.min_similarity, abs=0.02)
    assert mistaken.threshold < similarities.max()


def test_of_several_kinds_the_lowest_is_verified_and_the_highest_believed(
    certificate, scenes, alike
):
    alone = calibrate("gradients", GradientRecognizer(), [alike])
    both = calibrate("gradients", GradientRecognizer(), [scenes, alike])
    assert certificate.min_similarity < alone.min_similarity
    assert both.min_similarity == certificate.min_similarity
    assert both.threshold == max(certificate.threshold, alone.threshold)
    assert [kind.data for kind in both.kinds] == ["twelve places", "all alike"]


def test_each_kind_says_what_the_thresholds_of_the_others_do_to_it(scenes, alike):
    first, second = calibrate("gradients", GradientRecognizer(), [scenes, alike]).kinds
    for kind, other, own in ((first, second, scenes), (second, first, alike)):
        right, wrong = pairs_of(own.datasets[0], own.embeddings[0])
        for reached, threshold in (
            (kind.left_out_to_verify, other.min_similarity),
            (kind.left_out_tau, other.threshold),
        ):
            assert reached.threshold == threshold
            assert reached.different_places == pytest.approx((wrong >= threshold).mean())
            assert reached.same_place == pytest.approx((right >= threshold).mean())
    assert second.left_out_to_verify.different_places > 0.02  # that kind is not like the first


def test_datasets_of_one_kind_are_as_one(dataset, embeddings, scenes, alike):
    (kind,) = calibrate(
        "gradients",
        GradientRecognizer(),
        [Scenes("rooms", [dataset, dataset], [embeddings, alike.embeddings[0]])],
    ).kinds
    pairs = (pairs_of(dataset, each) for each in (embeddings, alike.embeddings[0]))
    right, wrong = map(np.concatenate, zip(*pairs, strict=True))
    assert (kind.images, kind.pairs, kind.same_place_pairs) == (96, 2 * 48 * 47 // 2, len(right))
    assert kind.different_places == pytest.approx(np.quantile(wrong, [0.01, 0.99]))
    assert kind.same_place == pytest.approx(np.quantile(right, [0.01, 0.99]))


def test_the_curve_ends_with_all_recalled(certificate, dataset, embeddings):
    right, wrong = pairs_of(dataset, embeddings)
    thresholds = [point[0] for point in certificate.curve]
    assert thresholds == sorted(thresholds, reverse=True)
    assert certificate.curve[-1][2] == 1.0
    for similarity, passing, recalled in certificate.curve[::20]:
        assert passing == pytest.approx((wrong >= similarity).mean())
        assert recalled == pytest.approx((right >= similarity).mean())


def test_same_seed_same_certificate(certificate, scenes):
    again = calibrate("gradients", GradientRecognizer(), [scenes])
    other = calibrate("gradients", GradientRecognizer(), [scenes], seed=1)
    assert again == certificate
    assert other.threshold == certificate.threshold
    assert other.threshold_interval != certificate.threshold_interval


def reached_by(share, similarities):
    """Return the lowest of the most similar that are a share of all, by counting."""
    falling = sorted(similarities, reverse=True)
    return next(s for n, s in enumerate(falling, start=1) if n >= share * len(falling) - 1e-9)


def naive_resample(dataset, embeddings, images):
    """Return where to verify, tau and its recall, of images drawn with repetition."""
    similarities = compare(embeddings, dataset)
    chosen = [
        (similarities[i, j], dataset.same_place[i, j])
        for a, i in enumerate(images)
        for j in images[:a]
        if dataset.comparable[i, j]
    ]
    wrong = [s for s, right in chosen if not right]
    right = np.array([s for s, right in chosen if right])
    tau = reached_by(0.001, wrong)
    return reached_by(0.01, wrong), tau, (right >= tau).mean()


@pytest.mark.parametrize("labelled", [True, False])
def test_intervals_agree_with_a_naive_bootstrap(dataset, embeddings, monkeypatch, labelled):
    monkeypatch.setattr(bootstrap, "RESAMPLES", 20)
    if not labelled:
        dataset = replace(dataset, places=None)
    scenes = Scenes("twelve places", [dataset], [embeddings])
    certificate = calibrate("gradients", GradientRecognizer(), [scenes], seed=3)
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
    assert certificate.kinds[0].resampled == ("places" if labelled else "images")
    assert certificate.resamples == 20
    found = ("min_similarity_interval", "threshold_interval", "recall_interval")
    for name, values in zip(found, np.transpose(drawn), strict=True):
        assert np.allclose(getattr(certificate, name), np.quantile(values, [0.025, 0.975]))


def test_intervals_hold_what_they_are_about(certificate):
    for value, (low, high) in (
        (certificate.min_similarity, certificate.min_similarity_interval),
        (certificate.threshold, certificate.threshold_interval),
        (certificate.recall, certificate.recall_interval),
    ):
        assert low < value < high


def test_queries_and_references_of_two_drives(dataset, embeddings):
    queries, references = np.arange(0, 48, 2), np.arange(1, 48, 2)
    drives = replace(
        dataset,
        queries=queries,
        references=references,
        same_place=dataset.same_place[np.ix_(queries, references)],
        comparable=np.ones((24, 24), bool),
    )
    scenes = Scenes("drives", [drives], [embeddings])
    (kind,) = calibrate("gradients", GradientRecognizer(), [scenes]).kinds
    assert kind.pairs == 24 * 24
    assert kind.same_place_pairs == 12 * 4

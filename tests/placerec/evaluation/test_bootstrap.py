# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec.datasets import PlaceDataset
from placerec.evaluation import bootstrap as module
from placerec.evaluation.bootstrap import bootstrap
from placerec.evaluation.precision_recall import evaluate


def drive(places, labelled=True):
    places = np.asarray(places)
    everyone = np.arange(len(places))
    return PlaceDataset(
        name="drive",
        paths=tuple(Path(f"{i}.png") for i in everyone),
        queries=everyone,
        references=everyone,
        same_place=places[:, None] == places,
        comparable=~np.eye(len(places), dtype=bool),
        places=places if labelled else None,
    )


def noisy(places, noise, levels=None):
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(max(places) + 1, 8))[places] + noise * rng.normal(size=(len(places), 8))
    if levels:
        rows = np.round(rows * levels)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


PLACES = np.repeat(np.arange(10), 3)


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("levels", [None, 1])
def test_intervals_agree_with_copies_of_the_pairs_drawn(monkeypatch, labelled, levels):
    monkeypatch.setattr(module, "RESAMPLES", 30)
    dataset, embeddings = drive(PLACES, labelled), noisy(PLACES, 1.2, levels)
    found = evaluate(dataset, embeddings)
    naive = [
        naive_figures(found.similarities, dataset, drawn)
        for drawn in module.draws(module.resampling_units(dataset), 7)
    ]
    expected = np.quantile(np.array(naive), [0.025, 0.975], axis=0)
    intervals = bootstrap(found, dataset, seed=7)
    ours = [intervals.average_precision, intervals.recall_at_full_precision]
    assert np.allclose(np.transpose(ours), expected)
    assert 0.0 < intervals.average_precision[0] < intervals.average_precision[1] < 1.0


def naive_figures(similarities, dataset, drawn):
    """Write every pair, and every query's best match, down as often as it was drawn."""
    pairs, best, total = [], [], 0
    for i in range(len(drawn)):
        row = [
            (similarities[i, j], not dataset.same_place[i, j], j)
            for j in range(len(drawn))
            if dataset.comparable[i, j]
        ]
        for similarity, is_wrong, j in row:
            if i < j:
                together = dataset.places is not None and dataset.places[i] == dataset.places[j]
                times = drawn[i] if together else drawn[i] * drawn[j]
                pairs += [(similarity, is_wrong)] * int(times)
        similarity, is_wrong, _ = max(row)
        best += [(similarity, is_wrong)] * int(drawn[i])
        total += int(drawn[i]) * any(not is_wrong for _, is_wrong, _ in row)
    value, before, right = 0.0, 0.0, sum(not is_wrong for _, is_wrong in pairs)
    for threshold in sorted({s for s, _ in pairs}, reverse=True):
        kept = [not is_wrong for s, is_wrong in pairs if s >= threshold]
        value += (sum(kept) / right - before) * sum(kept) / len(kept)
        before = sum(kept) / right
    limit = max((s for s, is_wrong in best if is_wrong), default=-np.inf)
    return value, sum(s > limit for s, is_wrong in best if not is_wrong) / total


def test_figures_lie_within_and_the_seed_decides():
    dataset = drive(PLACES)
    found = evaluate(dataset, noisy(PLACES, 0.8))
    intervals = bootstrap(found, dataset)
    low, high = intervals.average_precision
    assert low < found.pair_curve.area < high
    low, high = intervals.recall_at_full_precision
    assert low <= found.best_match_curve.recall_at_full_precision <= high
    assert bootstrap(found, dataset) == intervals
    assert bootstrap(found, dataset, seed=1) != intervals


def test_what_is_drawn_twice_is_not_compared_with_itself():
    """Pairs within a place would otherwise count twice as much, on average, as all others."""
    places = np.repeat(np.arange(60), 3)
    dataset, embeddings = drive(places), noisy(places, 1.6)
    found = evaluate(dataset, embeddings)
    low, high = bootstrap(found, dataset).average_precision
    assert low < found.pair_curve.area < high
    assert abs((low + high) / 2 - found.pair_curve.area) < 0.25 * (high - low)


def test_more_images_make_it_narrower_and_perfection_has_no_width():
    widths = []
    for count in (8, 64):
        places = np.repeat(np.arange(count), 3)
        dataset = drive(places)
        low, high = bootstrap(evaluate(dataset, noisy(places, 0.8)), dataset).average_precision
        widths.append(high - low)
    assert widths[1] < widths[0]
    perfect = bootstrap(
        evaluate(drive(PLACES), np.eye(10, dtype=np.float32)[PLACES]), drive(PLACES)
    )
    assert perfect.average_precision == perfect.recall_at_full_precision == (1.0, 1.0)


def test_resamples_without_any_revisit_do_not_count():
    places = np.array([0, 0, 1, 2, 3, 4])
    dataset = drive(places, labelled=False)
    intervals = bootstrap(evaluate(dataset, np.eye(5, dtype=np.float32)[places]), dataset)
    assert intervals.average_precision == (1.0, 1.0)


def test_queries_and_references_of_two_drives_are_drawn_alike():
    first = drive(np.arange(6), labelled=False)
    dataset = replace(
        first,
        paths=first.paths * 2,
        references=np.arange(6, 12),
        comparable=np.ones((6, 6), bool),
    )
    embeddings = noisy(np.tile(np.arange(6), 2), 1.0)
    found = evaluate(dataset, embeddings)
    low, high = bootstrap(found, dataset).average_precision
    assert 0.0 <= low <= found.pair_curve.area <= high <= 1.0

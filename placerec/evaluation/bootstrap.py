# SPDX-License-Identifier: Apache-2.0
"""How far figures would move with other images of the same kind: intervals by resampling."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset
from placerec.evaluation.precision_recall import (
    BestMatches,
    Evaluation,
    Indices,
    ends_of_ties,
    ranked_pairs,
)

RESAMPLES = 1000
CONFIDENCE = 0.95

Interval = tuple[float, float]


@dataclass(frozen=True)
class Intervals:
    """Within which 95 % of the resamples lie.

    Attributes:
        average_precision: over all pairs; both images of a pair are drawn. A place that is drawn
            twice counts as two places: none of its images is compared with its own double.
        recall_at_full_precision: of the best matches; queries are drawn, references stay.
    """

    average_precision: Interval
    recall_at_full_precision: Interval


def bootstrap(evaluation: Evaluation, dataset: PlaceDataset, seed: int = 0) -> Intervals:
    """Return the intervals of an evaluation; the same seed gives the same ones."""
    unit = resampling_units(dataset)
    pairs = _Pairs(evaluation.similarities, dataset, unit)
    revisits = np.any(dataset.comparable & dataset.same_place, axis=1)
    precisions, recalls = [], []
    for drawn in draws(unit, seed):
        precisions.append(pairs.average_precision(drawn))
        recalls.append(_recall(evaluation.best_matches, revisits, drawn[dataset.queries]))
    return Intervals(
        average_precision=interval(precisions),
        recall_at_full_precision=interval(recalls),
    )


def resampling_units(dataset: PlaceDataset) -> Indices:
    """Return for each of the (N,) images what it is drawn together with, counted from 0.

    Whole places where they are known: images of one place are alike, and drawn one by one they
    would make the interval too narrow.
    """
    units = np.arange(len(dataset)) if dataset.places is None else dataset.places
    _, unit = np.unique(units, return_inverse=True)
    return unit.astype(np.int64)


def draws(unit: Indices, seed: int) -> Iterator[Indices]:
    """Yield how often each of the (N,) images is drawn in each resample."""
    rng = np.random.default_rng(seed)
    count = int(unit.max()) + 1
    for _ in range(RESAMPLES):
        yield np.bincount(rng.integers(count, size=count), minlength=count)[unit]


class _Pairs:
    """All pairs that count by falling similarity, sorted once for all resamples."""

    def __init__(self, similarities: Similarities, dataset: PlaceDataset, unit: Indices) -> None:
        rows, columns = ranked_pairs(similarities, dataset.pairs)
        self._queries, self._references = dataset.queries[rows], dataset.references[columns]
        self._within = np.flatnonzero(unit[self._queries] == unit[self._references])
        self._right = np.flatnonzero(dataset.same_place[rows, columns])
        # Each right pair counts with the last of those that are as similar.
        last = ends_of_ties(similarities[rows, columns])
        ends = last[np.searchsorted(last, self._right)]
        self._ends, self._step = np.unique(ends, return_inverse=True)

    def average_precision(self, drawn: Indices) -> float:
        """Return it with each pair as often as its images are drawn; NaN if no right one is."""
        weights = drawn.take(self._queries) * drawn.take(self._references)
        weights[self._within] = drawn[self._queries[self._within]]
        right = weights[self._right]
        total = int(right.sum())
        if total == 0:
            return float("nan")
        recognised = np.cumsum(weights)[self._ends]
        gains = np.bincount(self._step, right, len(self._ends))
        drawn_steps = gains > 0
        precision = np.cumsum(gains)[drawn_steps] / recognised[drawn_steps]
        return float(gains[drawn_steps] @ precision) / total


def _recall(best: BestMatches, revisits: NDArray[np.bool_], drawn: Indices) -> float:
    """Return the recall without an error, each query as often as it is drawn; NaN without any."""
    total = int(drawn[revisits].sum())
    if total == 0:
        return float("nan")
    weights = drawn[best.queries]
    wrong = best.similarities[~best.are_right & (weights > 0)]
    clean = best.are_right & (best.similarities > wrong.max(initial=-np.inf))
    return float(weights[clean].sum() / total)


def interval(values: list[float]) -> Interval:
    """Return within which bounds the middle 95 % of the resamples lie; NaN are left out."""
    tails = [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0]
    low, high = np.nanquantile(values, tails)
    return float(low), float(high)

# SPDX-License-Identifier: Apache-2.0
"""How well similarities tell same places from different ones.

Wherever similarities are equal, no order is assumed in the recognizer's favour. What a dataset
cannot show is refused with a RecognizerError: curves and recalls need two images of it that are of
one place, and two that are of different ones.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import COSINES, Comparer, Embeddings, Similarities
from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError

FloatArray = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Curve:
    """Precision and recall as the threshold falls.

    Attributes:
        thresholds: (T,) float64, falling: all different similarities; what is as similar or more
            counts as recognised.
        precision: (T,) float64, the share of the recognised that is right.
        recall: (T,) float64, the share of what is right that is recognised.
    """

    thresholds: FloatArray
    precision: FloatArray
    recall: FloatArray

    @property
    def area(self) -> float:
        """The sum of precision over the steps of recall: no interpolation (average precision)."""
        return float(np.diff(self.recall, prepend=0.0) @ self.precision)

    @property
    def recall_at_full_precision(self) -> float:
        """The largest recall without a single error."""
        return float(self.recall[self.precision == 1.0].max(initial=0.0))

    @property
    def balanced_threshold(self) -> float:
        """Where precision and recall are largest together (their harmonic mean)."""
        together = np.maximum(self.precision + self.recall, np.finfo(float).tiny)
        return float(self.thresholds[np.argmax(self.precision * self.recall / together)])


@dataclass(frozen=True)
class BestMatches:
    """The most similar reference of each query that has any to be compared with.

    Attributes:
        queries, references: (B,) int64, rows and columns of the dataset's matrices.
        similarities: (B,) float32.
        are_right: (B,) bool, whether both show one place; where a wrong reference is as similar as
            a right one, the wrong one is the match.
    """

    queries: Indices
    references: Indices
    similarities: Similarities
    are_right: NDArray[np.bool_]


@dataclass(frozen=True)
class Evaluation:
    """What a recognizer does on a dataset.

    Attributes:
        similarities: (Q, R) float32, of all queries and references.
        pair_curve: over all pairs that count; its area is the average precision.
        best_matches: each query's most similar reference.
        best_match_curve: over these.
        recall_at_1, recall_at_5, recall_at_10: the share of queries with a right reference among
            the first k.
    """

    similarities: Similarities
    pair_curve: Curve
    best_matches: BestMatches
    best_match_curve: Curve
    recall_at_1: float
    recall_at_5: float
    recall_at_10: float


def evaluate(
    dataset: PlaceDataset, embeddings: Embeddings, comparer: Comparer = COSINES
) -> Evaluation:
    """Judge the (N, *S) embeddings of a dataset's images, compared as their recognizer does it.

    Raises:
        RecognizerError: the dataset has no pair of one place, or none of different places, or
            the embeddings cannot be compared.
    """
    return judge(compare(embeddings, dataset, comparer), dataset)


def judge(similarities: Similarities, dataset: PlaceDataset) -> Evaluation:
    """Judge (Q, R) similarities of a dataset's queries and references.

    Raises:
        RecognizerError: the dataset has no pair of one place, or none of different places.
    """
    return Evaluation(
        similarities=similarities,
        pair_curve=pair_curve(similarities, dataset),
        best_matches=best_matches(similarities, dataset),
        best_match_curve=best_match_curve(similarities, dataset),
        recall_at_1=recall_at(1, similarities, dataset),
        recall_at_5=recall_at(5, similarities, dataset),
        recall_at_10=recall_at(10, similarities, dataset),
    )


def refuse_without_truth(dataset: PlaceDataset) -> None:
    """Refuse a dataset on which nothing can be measured.

    Raises:
        RecognizerError: no two images of it are of one place, or of different ones.
    """
    same = dataset.same_place[dataset.pairs]
    if not same.any() or same.all():
        kind = "different places" if same.any() else "the same place"
        raise RecognizerError(
            f"{dataset.name} has no pair of images of {kind} among the {same.size} that count; "
            "nothing can be measured on it"
        )


def compare(
    embeddings: Embeddings, dataset: PlaceDataset, comparer: Comparer = COSINES
) -> Similarities:
    """Return the (Q, R) similarities between a dataset's queries and references.

    Raises:
        RecognizerError: the recognizer that compares them fails.
    """
    return comparer.compare(embeddings[dataset.queries], embeddings[dataset.references])


def pair_curve(similarities: Similarities, dataset: PlaceDataset) -> Curve:
    """Return precision and recall over all pairs that count, each once."""
    refuse_without_truth(dataset)
    counted = dataset.pairs
    right = dataset.same_place[counted]
    return _curve(similarities[counted], right, total=int(right.sum()))


def best_match_curve(similarities: Similarities, dataset: PlaceDataset) -> Curve:
    """Return precision and recall of each query's best match.

    A query without any reference of its place takes part: its best match is an error. The recall
    is of the queries that have one.
    """
    refuse_without_truth(dataset)
    best = best_matches(similarities, dataset)
    revisits = (dataset.comparable & dataset.same_place).any(axis=1)
    return _curve(best.similarities, best.are_right, total=int(revisits.sum()))


def best_matches(similarities: Similarities, dataset: PlaceDataset) -> BestMatches:
    """Return the most similar reference of each query, of those that may be compared with it."""
    right, wrong = _split(similarities, dataset)
    is_right = right.max(axis=1, initial=-np.inf) > wrong.max(axis=1, initial=-np.inf)
    ranked = np.where(is_right[:, None], right, wrong)
    queries = np.flatnonzero(ranked.max(axis=1, initial=-np.inf) > -np.inf)
    references = ranked[queries].argmax(axis=1)
    return BestMatches(queries, references, similarities[queries, references], is_right[queries])


def recall_at(k: int, similarities: Similarities, dataset: PlaceDataset) -> float:
    """Return the share of queries that have a right one among their k most similar references.

    Of all queries that have a right reference at all.
    """
    refuse_without_truth(dataset)
    right, wrong = _split(similarities, dataset)
    best_right = right.max(axis=1, initial=-np.inf)
    ahead = (wrong >= best_right[:, None]).sum(axis=1)
    return float((ahead[best_right > -np.inf] < k).mean())


def _split(similarities: Similarities, dataset: PlaceDataset) -> tuple[Similarities, Similarities]:
    """Return the (Q, R) similarities of right pairs, and of wrong ones; all others are -inf."""
    right = dataset.comparable & dataset.same_place
    wrong = dataset.comparable & ~dataset.same_place
    return np.where(right, similarities, -np.inf), np.where(wrong, similarities, -np.inf)


def ranked_pairs(similarities: Similarities, chosen: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """Return rows and columns of the chosen among (Q, R) pairs, the most similar first."""
    rows, columns = np.nonzero(chosen)
    order = np.argsort(-similarities[rows, columns], kind="stable")
    return rows[order], columns[order]


def ends_of_ties(falling: NDArray[np.floating]) -> Indices:
    """Return where each run of equal values ends: these pass a threshold together."""
    return np.flatnonzero(np.append(falling[1:] != falling[:-1], True))


def _curve(similarities: Similarities, right: NDArray[np.bool_], total: int) -> Curve:
    """Return the curve of (M,) matches; total is how many right ones there could be."""
    order = np.argsort(-similarities, kind="stable")
    falling = similarities[order].astype(np.float64)
    last = ends_of_ties(falling)
    recognised_right = np.cumsum(right[order])[last]
    return Curve(falling[last], recognised_right / (last + 1), recognised_right / total)

# SPDX-License-Identifier: Apache-2.0
"""How well similarities tell same places from different ones.

Wherever similarities are equal, no order is assumed in the recognizer's favour.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from placerec.datasets import PlaceDataset
from placerec.recognizer import CheckedRecognizer, PlaceRecognizer, RecognizerError

FloatArray = NDArray[np.float64]
Embeddings = NDArray[np.float32]
Similarities = NDArray[np.float32]


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


@dataclass(frozen=True)
class Evaluation:
    """What a recognizer does on a dataset.

    Attributes:
        pair_curve: over all pairs that count; its area is the average precision.
        best_match_curve: over each query's most similar reference.
        recall_at_1, recall_at_5: the share of queries with a right reference among the first k.
    """

    pair_curve: Curve
    best_match_curve: Curve
    recall_at_1: float
    recall_at_5: float


def evaluate(dataset: PlaceDataset, embeddings: Embeddings) -> Evaluation:
    """Judge the (N, D) embeddings of a dataset's images.

    Raises:
        RecognizerError: the dataset has no pair of one place, or none of different places.
    """
    similarities = compare(embeddings, dataset)
    return Evaluation(
        pair_curve=pair_curve(similarities, dataset),
        best_match_curve=best_match_curve(similarities, dataset),
        recall_at_1=recall_at(1, similarities, dataset),
        recall_at_5=recall_at(5, similarities, dataset),
    )


def embed_all(
    recognizer: PlaceRecognizer, images: Iterable[NDArray[np.uint8]]
) -> tuple[Embeddings, FloatArray]:
    """Return the (N, D) embeddings of N images and the (N,) seconds that each took.

    Raises:
        RecognizerError: the recognizer fails or breaks its protocol, or there is no image.
    """
    checked = CheckedRecognizer(recognizer)
    embeddings, seconds = [], []
    for image in images:
        start = perf_counter()
        embeddings.append(checked.embed(image))
        seconds.append(perf_counter() - start)
    if not embeddings:
        raise RecognizerError("there is no image to embed")
    return np.stack(embeddings), np.array(seconds)


def compare(embeddings: Embeddings, dataset: PlaceDataset) -> Similarities:
    """Return the (Q, R) cosines between a dataset's queries and references."""
    # Added up in double precision, so that equal pairs tie however BLAS splits the sums.
    rows = embeddings.astype(np.float64)
    products = rows[dataset.queries] @ rows[dataset.references].T
    similarities: Similarities = products.astype(np.float32)
    return similarities


def pair_curve(similarities: Similarities, dataset: PlaceDataset) -> Curve:
    """Return precision and recall over all pairs that count, each once.

    Raises:
        RecognizerError: no two images of the dataset are of one place, or of different ones.
    """
    _check(dataset)
    counted = dataset.pairs
    right = dataset.same_place[counted]
    return _curve(similarities[counted], right, total=int(right.sum()))


def best_match_curve(similarities: Similarities, dataset: PlaceDataset) -> Curve:
    """Return precision and recall of each query's best match.

    A query without any reference of its place takes part: its best match is an error. The recall
    is of the queries that have one.

    Raises:
        RecognizerError: no two images of the dataset are of one place, or of different ones.
    """
    _check(dataset)
    best_right, best_wrong = _best(similarities, dataset)
    best = np.maximum(best_right, best_wrong)
    has_match = best > -np.inf
    right = best_right > best_wrong
    total = int((best_right > -np.inf).sum())
    return _curve(best[has_match], right[has_match], total)


def recall_at(k: int, similarities: Similarities, dataset: PlaceDataset) -> float:
    """Return the share of queries that have a right one among their k most similar references.

    Of all queries that have a right reference at all.

    Raises:
        RecognizerError: no two images of the dataset are of one place, or of different ones.
    """
    _check(dataset)
    best_right, _ = _best(similarities, dataset)
    wrong = dataset.comparable & ~dataset.same_place
    ahead = (wrong & (similarities >= best_right[:, None])).sum(axis=1)
    return float((ahead[best_right > -np.inf] < k).mean())


def _best(similarities: Similarities, dataset: PlaceDataset) -> tuple[Similarities, Similarities]:
    """Return each query's (Q,) largest similarity to a right and to a wrong reference."""
    right = dataset.comparable & dataset.same_place
    wrong = dataset.comparable & ~dataset.same_place
    return (
        np.where(right, similarities, -np.inf).max(axis=1, initial=-np.inf),
        np.where(wrong, similarities, -np.inf).max(axis=1, initial=-np.inf),
    )


def _curve(similarities: Similarities, right: NDArray[np.bool_], total: int) -> Curve:
    """Return the curve of (M,) matches; total is how many right ones there could be."""
    order = np.argsort(-similarities, kind="stable")
    falling = similarities[order].astype(np.float64)
    # Equal similarities pass a threshold together: the curve has one point for all of them.
    last = np.flatnonzero(np.append(falling[1:] != falling[:-1], True))
    recognised_right = np.cumsum(right[order])[last]
    return Curve(falling[last], recognised_right / (last + 1), recognised_right / total)


def _check(dataset: PlaceDataset) -> None:
    same = dataset.same_place[dataset.pairs]
    if not same.any() or same.all():
        kind = "different places" if same.any() else "the same place"
        raise RecognizerError(
            f"{dataset.name} has no pair of images of {kind} among the {same.size} that count; "
            "nothing can be measured on it"
        )

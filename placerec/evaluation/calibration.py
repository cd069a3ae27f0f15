# SPDX-License-Identifier: Apache-2.0
"""From which similarity is a match worth verifying, and from which is it one place for sure?"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import TAIL, Certificate, fingerprint
from placerec.checked_recognizer import CheckedRecognizer, Embeddings, Similarities
from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation.bootstrap import CONFIDENCE, draws, resampling_units
from placerec.evaluation.precision_recall import Curve, compare, pair_curve
from placerec.recognizer import PlaceRecognizer

CURVE_POINTS = 200
BLOCK = 4096

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class _Pairs:
    """M pairs of images by falling similarity: (M,) image indices of each side."""

    similarities: Similarities
    query: Indices
    reference: Indices

    def weights(self, drawn: Indices, part: slice = slice(None)) -> Indices:
        """Return how often each pair of a part occurs when image i is drawn (N,) times."""
        return drawn[self.query[part]] * drawn[self.reference[part]]


def calibrate(
    name: str,
    recognizer: PlaceRecognizer,
    dataset: PlaceDataset,
    embeddings: Embeddings,
    seed: int = 0,
) -> Certificate:
    """Return what a dataset says about a recognizer's thresholds.

    Args:
        name: what the recognizer was loaded by.
        recognizer: the one that made the embeddings.
        dataset: images that neither training nor a choice has seen.
        embeddings: (N, *S) of its images.
        seed: of the bootstrap.

    Raises:
        RecognizerError: every threshold has an error, or the dataset shows nothing.
    """
    similarities = compare(embeddings, dataset, CheckedRecognizer(recognizer, name))
    curve = pair_curve(similarities, dataset)
    right = _pairs(similarities, dataset, dataset.pairs & dataset.same_place)
    wrong = _pairs(similarities, dataset, dataset.pairs & ~dataset.same_place)
    clean = int((curve.precision == 1.0).sum())
    if clean == 0:
        raise RecognizerError(_no_threshold(name, dataset, wrong))
    thresholds, recalls = _bootstrap(right, wrong, dataset, seed)
    tails = [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0]
    different, same = (
        np.quantile(kind.similarities, [TAIL, 1.0 - TAIL]) for kind in (wrong, right)
    )
    return Certificate(
        recognizer=name,
        fingerprint=fingerprint(recognizer),
        data=dataset.name,
        images=len(dataset),
        skipped=len(dataset.skipped),
        pairs=wrong.similarities.size + right.similarities.size,
        same_place_pairs=right.similarities.size,
        threshold=curve.thresholds[clean - 1],
        highest_wrong=wrong.similarities[0],
        recall=curve.recall_at_full_precision,
        threshold_interval=tuple(np.quantile(thresholds, tails)),
        recall_interval=tuple(np.quantile(recalls, tails)),
        resampled="images" if dataset.places is None else "places",
        resamples=len(recalls),
        without_threshold=len(recalls) - len(thresholds),
        seed=seed,
        different_places=tuple(different),
        same_place=tuple(same),
        recall_to_verify=float((right.similarities >= different[1]).mean()),
        curve=_thinned(curve, clean - 1),
    )


def _pairs(similarities: Similarities, dataset: PlaceDataset, chosen: NDArray[np.bool_]) -> _Pairs:
    rows, columns = np.nonzero(chosen)
    order = np.argsort(-similarities[rows, columns], kind="stable")
    rows, columns = rows[order], columns[order]
    return _Pairs(similarities[rows, columns], dataset.queries[rows], dataset.references[columns])


def _no_threshold(name: str, dataset: PlaceDataset, wrong: _Pairs) -> str:
    first, second = (dataset.paths[side[0]] for side in (wrong.query, wrong.reference))
    return (
        f"no threshold keeps {name} free of errors on {dataset.name}: its most similar pair, at "
        f"{wrong.similarities[0]:.4f}, is of different places; if it is not, correct the ground "
        f"truth: {first} and {second}"
    )


def _bootstrap(
    right: _Pairs, wrong: _Pairs, dataset: PlaceDataset, seed: int
) -> tuple[list[float], list[float]]:
    """Return the threshold of each resample that has one, and the recall of each."""
    thresholds, recalls = [], []
    for drawn in draws(resampling_units(dataset), seed):
        weights = right.weights(drawn)
        above = right.similarities > _highest_drawn(wrong, drawn)
        recalls.append(float(weights[above].sum() / max(1, weights.sum())))
        recognised = right.similarities[above & (weights > 0)]
        if recognised.size:
            thresholds.append(float(recognised[-1]))
    return thresholds, recalls


def _highest_drawn(pairs: _Pairs, drawn: Indices) -> float:
    for start in range(0, len(pairs.similarities), BLOCK):
        present = np.flatnonzero(pairs.weights(drawn, slice(start, start + BLOCK)))
        if present.size:
            return float(pairs.similarities[start + present[0]])
    return -np.inf


def _thinned(curve: Curve, keep: int) -> tuple[tuple[float, float, float], ...]:
    """Return points at even steps among those where the recall rises, and the one to keep."""
    rises = np.flatnonzero(np.diff(curve.recall, prepend=0.0))
    few = np.linspace(0, len(rises) - 1, min(CURVE_POINTS, len(rises))).astype(int)
    return tuple(
        (float(curve.thresholds[i]), float(curve.precision[i]), float(curve.recall[i]))
        for i in np.union1d(rises[few], [keep])
    )

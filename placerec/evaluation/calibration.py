# SPDX-License-Identifier: Apache-2.0
"""From which similarity is a match worth verifying, and from which is it one place for sure?"""

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import TAIL, Certificate, fingerprint
from placerec.checked_recognizer import CheckedRecognizer, Embeddings, Similarities
from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation.bootstrap import draws, interval, resampling_units
from placerec.evaluation.precision_recall import Curve, Indices, compare, pair_curve, ranked_pairs
from placerec.recognizer import PlaceRecognizer

_CURVE_POINTS = 200
_BLOCK = 4096


class _Pairs:
    """The chosen among a dataset's pairs, the most similar first."""

    def __init__(
        self, similarities: Similarities, dataset: PlaceDataset, chosen: NDArray[np.bool_]
    ) -> None:
        rows, columns = ranked_pairs(similarities, chosen)
        self.similarities = similarities[rows, columns]
        self.query, self.reference = dataset.queries[rows], dataset.references[columns]

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
    right = _Pairs(similarities, dataset, dataset.pairs & dataset.same_place)
    wrong = _Pairs(similarities, dataset, dataset.pairs & ~dataset.same_place)
    clean = int((curve.precision == 1.0).sum())
    if clean == 0:
        first, second = (dataset.paths[side[0]] for side in (wrong.query, wrong.reference))
        raise RecognizerError(
            f"no threshold keeps {name} free of errors on {dataset.name}: its most similar pair, "
            f"at {wrong.similarities[0]:.4f}, is of different places; if it is not, correct the "
            f"ground truth: {first} and {second}"
        )
    thresholds, recalls = _bootstrap(right, wrong, dataset, seed)
    different = np.quantile(wrong.similarities, [TAIL, 1.0 - TAIL])
    same = np.quantile(right.similarities, [TAIL, 1.0 - TAIL])
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
        threshold_interval=interval(thresholds),
        recall_interval=interval(recalls),
        resampled="images" if dataset.places is None else "places",
        resamples=len(recalls),
        without_threshold=len(recalls) - len(thresholds),
        seed=seed,
        different_places=tuple(different),
        same_place=tuple(same),
        recall_to_verify=float((right.similarities >= different[1]).mean()),
        curve=_thinned(curve, clean - 1),
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
    for start in range(0, len(pairs.similarities), _BLOCK):
        present = np.flatnonzero(pairs.weights(drawn, slice(start, start + _BLOCK)))
        if present.size:
            return float(pairs.similarities[start + present[0]])
    return -np.inf


def _thinned(curve: Curve, keep: int) -> tuple[tuple[float, float, float], ...]:
    """Return points at even steps among those where the recall rises, and the one to keep."""
    rises = np.flatnonzero(np.diff(curve.recall, prepend=0.0))
    few = np.linspace(0, len(rises) - 1, min(_CURVE_POINTS, len(rises))).astype(int)
    return tuple(
        (float(curve.thresholds[i]), float(curve.precision[i]), float(curve.recall[i]))
        for i in np.union1d(rises[few], [keep])
    )

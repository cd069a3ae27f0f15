# SPDX-License-Identifier: Apache-2.0
"""From which similarity is a match worth verifying, and from which is it taken for one place?"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from placerec.certificate import SURE, TAIL, Certificate, Kind, Reached, fingerprint
from placerec.checked_recognizer import CheckedRecognizer, Comparer, Embeddings, Similarities
from placerec.datasets import PlaceDataset
from placerec.evaluation.bootstrap import draws, interval, resampling_units
from placerec.evaluation.precision_recall import Indices, compare
from placerec.recognizer import PlaceRecognizer

_CURVE_POINTS = 200


@dataclass(frozen=True)
class Scenes:
    """Datasets that show one kind of scene.

    Attributes:
        name: short name, for people.
        datasets: images that neither training nor a choice has seen, of one place and of different
            ones.
        embeddings: (N, *S) of the images of each dataset.
    """

    name: str
    datasets: Sequence[PlaceDataset]
    embeddings: Sequence[Embeddings]


@dataclass(frozen=True)
class _Pairs:
    """The pairs of a kind of scene that show one place, or those that do not.

    Attributes:
        similarities: (P,) float32, falling.
        query, reference: (P,) the images, counted through all datasets of the kind.
    """

    similarities: Similarities
    query: Indices
    reference: Indices

    def reached_by(self, share: float, drawn: Indices | None = None) -> float:
        """Return the similarity that a share of the pairs reaches: of all, or of those drawn.

        Image i is drawn (N,) times, and a pair as often as both of its images together.
        """
        if drawn is None:
            return float(np.quantile(self.similarities, 1.0 - share))
        reached = np.cumsum(drawn[self.query] * drawn[self.reference])
        last = int(np.searchsorted(reached, share * reached[-1]))
        return float(self.similarities[last])

    def reaching(self, similarity: float, drawn: Indices | None = None) -> float:
        """Return the share of the pairs, of all or of those drawn, that reach a similarity."""
        reach = self.similarities >= similarity
        if drawn is None:
            return float(reach.mean())
        counts = drawn[self.query] * drawn[self.reference]
        return float(counts[reach].sum() / max(1, counts.sum()))


class _Kind:
    """A kind of scene, compared.

    Attributes:
        right, wrong: the pairs of one place, and of different places.
        unit: (N,) what each image is drawn together with.
    """

    def __init__(self, scenes: Scenes, comparer: Comparer) -> None:
        self.scenes = scenes
        units, parts = [], []
        images = drawn = 0
        for dataset, embeddings in zip(scenes.datasets, scenes.embeddings, strict=True):
            rows, columns = np.nonzero(dataset.pairs)
            similarities = compare(embeddings, dataset, comparer)[rows, columns]
            same = dataset.same_place[rows, columns]
            sides = dataset.queries[rows] + images, dataset.references[columns] + images
            parts.append((similarities, *sides, same))
            units.append(resampling_units(dataset) + drawn)
            images, drawn = images + len(dataset), int(units[-1].max()) + 1
        self.unit = np.concatenate(units)
        together = [np.concatenate(each) for each in zip(*parts, strict=True)]
        order = np.argsort(-together[0], kind="stable")
        similarities, query, reference, same = (each[order] for each in together)
        self.right = _Pairs(similarities[same], query[same], reference[same])
        self.wrong = _Pairs(similarities[~same], query[~same], reference[~same])


def calibrate(
    name: str, recognizer: PlaceRecognizer, kinds: Sequence[Scenes], seed: int = 0
) -> Certificate:
    """Return what kinds of scenes say about a recognizer's thresholds.

    Args:
        name: what the recognizer was loaded by.
        recognizer: the one that made the embeddings.
        kinds: at least one, in which some pairs show one place and others do not.
        seed: of the bootstrap.

    Raises:
        RecognizerError: the recognizer fails to compare.
    """
    comparer = CheckedRecognizer(recognizer, name)
    compared = [_Kind(scenes, comparer) for scenes in kinds]
    to_verify, tau = _to_verify(compared), _tau(compared)
    resampled = _resampled(compared, seed)
    return Certificate(
        version=2,
        recognizer=name,
        fingerprint=fingerprint(recognizer),
        kinds=tuple(_described(k, compared) for k in range(len(compared))),
        recall_to_verify=_mean([kind.right.reaching(to_verify) for kind in compared]),
        recall=_mean([kind.right.reaching(tau) for kind in compared]),
        min_similarity_interval=interval(resampled[0]),
        threshold_interval=interval(resampled[1]),
        recall_interval=interval(resampled[2]),
        resamples=len(resampled[0]),
        seed=seed,
        curve=_curve(compared),
    )


def _to_verify(kinds: Sequence[_Kind], drawn: Sequence[Indices] | None = None) -> float:
    return min(_of_each(kinds, TAIL, drawn))


def _tau(kinds: Sequence[_Kind], drawn: Sequence[Indices] | None = None) -> float:
    return max(_of_each(kinds, SURE, drawn))


def _of_each(kinds: Sequence[_Kind], share: float, drawn: Sequence[Indices] | None) -> list[float]:
    """Return the similarity that a share of each kind's pairs of different places reaches."""
    each_drawn: Sequence[Indices | None] = drawn or [None] * len(kinds)
    return [
        kind.wrong.reached_by(share, images) for kind, images in zip(kinds, each_drawn, strict=True)
    ]


def _resampled(kinds: Sequence[_Kind], seed: int) -> tuple[list[float], list[float], list[float]]:
    """Return from where to verify, tau and the recall of tau, each of all resamples."""
    to_verify, taus, recalls = [], [], []
    for drawn in zip(*(draws(kind.unit, seed + k) for k, kind in enumerate(kinds)), strict=True):
        to_verify.append(_to_verify(kinds, drawn))
        taus.append(_tau(kinds, drawn))
        shares = zip(kinds, drawn, strict=True)
        recalls.append(_mean([kind.right.reaching(taus[-1], d) for kind, d in shares]))
    return to_verify, taus, recalls


def _described(k: int, kinds: Sequence[_Kind]) -> Kind:
    """Return what kind k is, and what the thresholds of all others do there."""
    own, others = kinds[k], [*kinds[:k], *kinds[k + 1 :]]
    datasets = own.scenes.datasets
    lowest, highest = 1.0 - TAIL, TAIL
    return Kind(
        data=own.scenes.name,
        images=len(own.unit),
        skipped=sum(len(dataset.skipped) for dataset in datasets),
        pairs=len(own.wrong.similarities) + len(own.right.similarities),
        same_place_pairs=len(own.right.similarities),
        resampled="images" if any(each.places is None for each in datasets) else "places",
        different_places=(own.wrong.reached_by(lowest), own.wrong.reached_by(highest)),
        same_place=(own.right.reached_by(lowest), own.right.reached_by(highest)),
        threshold=own.wrong.reached_by(SURE),
        left_out_to_verify=_reached(own, _to_verify(others)) if others else None,
        left_out_tau=_reached(own, _tau(others)) if others else None,
    )


def _reached(kind: _Kind, threshold: float) -> Reached:
    return Reached(
        threshold=threshold,
        different_places=kind.wrong.reaching(threshold),
        same_place=kind.right.reaching(threshold),
    )


def _curve(kinds: Sequence[_Kind]) -> tuple[tuple[float, float, float], ...]:
    """Return falling similarities and the shares that reach them, of the wrong and the right."""
    steps = np.linspace(0.0, 1.0, _CURVE_POINTS // len(kinds))
    at = np.unique([kind.right.reached_by(step) for kind in kinds for step in steps])[::-1]
    return tuple(
        (
            float(similarity),
            _mean([kind.wrong.reaching(similarity) for kind in kinds]),
            _mean([kind.right.reaching(similarity) for kind in kinds]),
        )
        for similarity in at
    )


def _mean(shares: Sequence[float]) -> float:
    return sum(shares) / len(shares)

# SPDX-License-Identifier: Apache-2.0
"""What contenders achieve on the evaluation sets, kept between calls."""

import hashlib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from benchmarks.place_recognition.contenders import Contender
from benchmarks.place_recognition.sets import EvaluationSet
from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset
from placerec.evaluation.precision_recall import (
    best_match_curve,
    compare,
    pair_curve,
    recall_at,
)
from placerec.files import write_atomically


@dataclass(frozen=True)
class Score:
    """The figures of one contender on one set.

    Attributes:
        average_precision: over all pairs.
        recall_at_1: of the queries with a revisit, those whose best match is one.
        recall_at_full_precision, best_match_area: of the curve of best matches.
    """

    average_precision: float
    recall_at_1: float
    recall_at_full_precision: float
    best_match_area: float


@dataclass(frozen=True)
class Measured:
    """A contender on all sets: scores by set, (Q, R) similarities by dataset."""

    scores: Mapping[str, Score]
    similarities: Mapping[str, Similarities]


def measure_all(
    contenders: Sequence[Contender], sets: Sequence[EvaluationSet], folder: Path
) -> dict[str, Measured]:
    """Return what each contender achieves; similarities are kept in a folder.

    Raises:
        RecognizerError: an image or weights cannot be read, or a file cannot be written.
    """
    found: dict[str, dict[str, Similarities]] = {each.name: {} for each in contenders}
    # Set by set: layers of one network are then worked out in one pass.
    for dataset in (dataset for each in sets for dataset in each.datasets):
        for contender in contenders:
            found[contender.name][dataset.name] = _similarities(contender, dataset, folder)
    return {name: Measured(_scores(values, sets), values) for name, values in found.items()}


def mean_score(scores: Iterable[Score]) -> Score:
    """Return the means of all figures."""
    listed = list(scores)
    names = [field.name for field in fields(Score)]
    return Score(*(float(np.mean([getattr(score, name) for score in listed])) for name in names))


def _scores(
    similarities: Mapping[str, Similarities], sets: Sequence[EvaluationSet]
) -> dict[str, Score]:
    return {
        each.name: mean_score(score_of(similarities[d.name], d) for d in each.datasets)
        for each in sets
    }


def score_of(similarities: Similarities, dataset: PlaceDataset) -> Score:
    """Return the figures of (Q, R) similarities."""
    best = best_match_curve(similarities, dataset)
    return Score(
        average_precision=pair_curve(similarities, dataset).area,
        recall_at_1=recall_at(1, similarities, dataset),
        recall_at_full_precision=best.recall_at_full_precision,
        best_match_area=best.area,
    )


def _similarities(contender: Contender, dataset: PlaceDataset, folder: Path) -> Similarities:
    images = [(path.name, path.stat().st_size) for path in dataset.paths]
    facts = repr((contender.name, contender.fingerprint, dataset.name, images))
    path = folder / f"{hashlib.sha256(facts.encode()).hexdigest()[:24]}.npy"
    if path.exists():
        kept: Similarities = np.load(path, allow_pickle=False)
        return kept
    print(f"{contender.name} on {dataset.name}", flush=True)
    similarities = compare(contender.embed(dataset), dataset)
    buffer = io.BytesIO()
    np.save(buffer, similarities)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, buffer.getvalue())
    return similarities

# SPDX-License-Identifier: Apache-2.0
"""What contenders achieve on images that no training has seen, kept between calls."""

import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.place_recognition.contenders import (
    Contender,
    gradients,
    learned,
    untrained_layers,
)
from benchmarks.place_recognition.trainings import (
    LOSSES,
    SEEDS,
    TRUNK_PLANS,
    compared_name,
    planned_trainings,
)
from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset, open_dataset
from placerec.evaluation.precision_recall import best_match_curve, compare, pair_curve, recall_at
from placerec.files import write_atomically

DESK, CORRIDOR, FLOORS, RENDERED = "fr1_desk", "corridor", "ie_tower test floors", "rendered rooms"
DEFAULT = "shipped default"


class EvaluationSet(NamedTuple):
    """Datasets whose figures are averaged."""

    name: str
    datasets: tuple[PlaceDataset, ...]


class Score(NamedTuple):
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


@dataclass(frozen=True)
class Results:
    """What was measured, by contender; a training that is not done is not in it.

    Attributes:
        sets: what it was measured on.
        found: by contender.
        layers: by trunk, the names of its untrained layers.
    """

    sets: Sequence[EvaluationSet]
    found: dict[str, Measured]
    layers: dict[str, list[str]]

    def values(self, names: Sequence[str], on: str, figure: str) -> list[float]:
        """Return one figure of each contender, of those that there are."""
        scores = [self.found[name].scores[on] for name in names if name in self.found]
        return [float(getattr(score, figure)) for score in scores]

    def precisions(self, names: Sequence[str], on: str) -> list[float]:
        """Return the average precision of each contender, of those that there are."""
        return self.values(names, on, "average_precision")

    def seeds(self, group: str, loss: str) -> list[str]:
        """Return the trainings of one group with one loss, only seeds that both losses have."""
        names = {seed: [compared_name(group, each, seed) for each in LOSSES] for seed in SEEDS}
        both = [seed for seed in SEEDS if all(name in self.found for name in names[seed])]
        return [compared_name(group, loss, seed) for seed in both]

    def best_layer(self, trunk: str, on: str = DESK) -> str:
        """Return the untrained layer with the largest average precision."""
        return max(self.layers[trunk], key=lambda name: self.precisions([name], on))


def collect(
    data: Path, validation: Path, trunk_weights: Path, runs: Path, default: Path
) -> Results:
    """Measure all that there is; without rendered paths, all but on them.

    Raises:
        RecognizerError: weights or images cannot be read, or a file cannot be written.
    """
    sets = _open_sets(data, validation)
    files = {DEFAULT: default} | {each.name: each.weights(runs) for each in planned_trainings()}
    contenders = [gradients()]
    for name, weights in files.items():
        if weights.exists():
            contenders.append(learned(name, weights))
        else:
            print(f"left out, there are no weights of it yet: {name}")
    found = _measure_all(contenders, sets, runs / "measured")
    layers = {}
    for trunk in TRUNK_PLANS:
        untrained = untrained_layers(trunk, trunk_weights)
        found |= _measure_all(untrained, sets, runs / "measured")
        layers[trunk] = [each.name for each in untrained]
    return Results(sets, found, layers)


def _open_sets(data: Path, validation: Path) -> list[EvaluationSet]:
    sources = {
        DESK: [str(data / "rgbd_dataset_freiburg1_desk")],
        CORRIDOR: [str(data / "corridor")],
        FLOORS: [f"{data / 'ie_tower'}:test"],
        RENDERED: sorted(str(path.parent) for path in validation.glob("*/rgb.txt")),
    }
    return [
        EvaluationSet(name, tuple(open_dataset(source) for source in folders))
        for name, folders in sources.items()
        if folders
    ]


def _measure_all(
    contenders: Sequence[Contender], sets: Sequence[EvaluationSet], folder: Path
) -> dict[str, Measured]:
    found: dict[str, dict[str, Similarities]] = {each.name: {} for each in contenders}
    # Set by set: layers of one network are then worked out in one pass.
    for dataset in (dataset for each in sets for dataset in each.datasets):
        for contender in contenders:
            found[contender.name][dataset.name] = _similarities(contender, dataset, folder)
    return {
        name: Measured({each.name: _mean_score(values, each) for each in sets}, values)
        for name, values in found.items()
    }


def _mean_score(similarities: Mapping[str, Similarities], each: EvaluationSet) -> Score:
    scores = [_score(similarities[dataset.name], dataset) for dataset in each.datasets]
    return Score(*map(float, np.mean(scores, axis=0)))


def _score(similarities: Similarities, dataset: PlaceDataset) -> Score:
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

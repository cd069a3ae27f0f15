# SPDX-License-Identifier: Apache-2.0
"""All that was measured, by what it stands for on the page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.place_recognition.contenders import Contender, gradients, learned, untrained_layers
from benchmarks.place_recognition.measured import Measured, measure_all
from benchmarks.place_recognition.sets import DESK, EvaluationSet
from benchmarks.place_recognition.trainings import (
    SEEDS,
    TRUNK_PLANS,
    compared_name,
    planned_trainings,
)

DEFAULT = "shipped default"
GRADIENTS = "gradients"


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

    def seeds(self, trunk: str, loss: str) -> list[str]:
        """Return the trainings of one trunk with one loss, only seeds that both losses have."""
        both = [seed for seed in SEEDS if self._has_both(trunk, seed)]
        return [compared_name(trunk, loss, seed) for seed in both]

    def best_layer(self, trunk: str, on: str = DESK) -> str:
        """Return the untrained layer with the largest average precision."""
        return max(self.layers[trunk], key=lambda name: self.precisions([name], on))

    def _has_both(self, trunk: str, seed: int) -> bool:
        names = (compared_name(trunk, loss, seed) for loss in ("multi-constraint", "triplet"))
        return all(name in self.found for name in names)


def collect(
    sets: Sequence[EvaluationSet], trunk_weights: Path, runs: Path, default: Path
) -> Results:
    """Measure all that there is.

    Raises:
        RecognizerError: weights or images cannot be read, or a file cannot be written.
    """
    folder = runs / "measured"
    contenders: list[Contender] = [gradients()]
    if default.exists():
        contenders.append(learned(DEFAULT, default))
    else:
        print(f"left out: there are no shipped weights yet: {default}")
    for planned in planned_trainings():
        if planned.weights(runs).exists():
            contenders.append(learned(planned.name, planned.weights(runs)))
        else:
            print(f"left out: not trained yet: {planned.name}")
    found = measure_all(contenders, sets, folder)
    layers = {}
    for trunk in TRUNK_PLANS:
        untrained = untrained_layers(trunk, trunk_weights)
        found |= measure_all(untrained, sets, folder)
        layers[trunk] = [each.name for each in untrained]
    return Results(sets, found, layers)

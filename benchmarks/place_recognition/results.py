# SPDX-License-Identifier: Apache-2.0
"""All that was measured, by what it stands for on the page."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.place_recognition.contenders import Contender, gradients, learned, untrained_layers
from benchmarks.place_recognition.measured import Measured, measure_all
from benchmarks.place_recognition.sets import DESK, EvaluationSet
from benchmarks.place_recognition.trainings import (
    LOSSES,
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
        return self.of_both(partial(compared_name, trunk), loss)

    def of_both(self, name_of: Callable[[str, int], str], loss: str) -> list[str]:
        """Return the trainings with one loss, called by loss and seed; seeds that both have."""
        both = [seed for seed in SEEDS if all(name_of(each, seed) in self.found for each in LOSSES)]
        return [name_of(loss, seed) for seed in both]

    def best_layer(self, trunk: str, on: str = DESK) -> str:
        """Return the untrained layer with the largest average precision."""
        return max(self.layers[trunk], key=lambda name: self.precisions([name], on))


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

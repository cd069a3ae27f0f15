# SPDX-License-Identifier: Apache-2.0
"""What embedding and comparing take on this machine, timed each time the page is written."""

from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.place_recognition.results import DEFAULT, GRADIENTS, Results
from benchmarks.place_recognition.trainings import (
    DIMENSIONS,
    MAIN_TRUNK,
    TRUNK_PLANS,
    compared_name,
    planned_trainings,
)
from placerec.datasets import PlaceDataset
from placerec.evaluation.measurement import Cost, measure_cost
from placerec.recognizer import PlaceRecognizer
from placerec.recognizers.gradients import GradientRecognizer
from placerec.recognizers.learned import LearnedRecognizer

IMAGES = 50


def measure_costs(
    results: Results, runs: Path, default: Path, dataset: PlaceDataset
) -> dict[str, Cost]:
    """Return the cost of what was measured, an image at a time as `run_slam` embeds them."""
    files = {planned.name: planned.weights(runs) for planned in planned_trainings()}
    files[DEFAULT] = default
    titles = {DEFAULT: DEFAULT} | {
        compared_name(trunk, "multi-constraint", 0): trunk for trunk in TRUNK_PLANS
    }
    titles |= {f"dimension-{n}": f"{MAIN_TRUNK}, {n} values" for n in DIMENSIONS}
    recognizers: dict[str, PlaceRecognizer] = {
        title: LearnedRecognizer(files[name])
        for name, title in titles.items()
        if name in results.found
    }
    recognizers[GRADIENTS] = GradientRecognizer()
    return {name: _cost(recognizer, dataset) for name, recognizer in recognizers.items()}


def _cost(recognizer: PlaceRecognizer, dataset: PlaceDataset) -> Cost:
    images = [dataset[i] for i in range(min(IMAGES, len(dataset)))]
    recognizer.embed(images[0])  # the first takes longer
    embeddings, seconds = [], []
    for image in images:
        start = perf_counter()
        embeddings.append(recognizer.embed(image))
        seconds.append(perf_counter() - start)
    return measure_cost(np.stack(embeddings), np.array(seconds))

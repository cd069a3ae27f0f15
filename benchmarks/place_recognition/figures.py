# SPDX-License-Identifier: Apache-2.0
"""The figures of the page, as files."""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.place_recognition.measured import EvaluationSet, Measured
from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset
from placerec.evaluation.figures import (
    bars,
    dimension_comparison,
    heat_maps,
    png,
    precision_recall,
    recognised_places,
    svg,
)
from placerec.evaluation.measurement import Cost
from placerec.evaluation.precision_recall import best_match_curve, best_matches, pair_curve
from placerec.files import write_atomically

PAPERS_EXTRACTION_MS = {"AlexNet, per pair of images": 22.0}
PAPERS_COMPARISON_MS = {"4096 values": 0.0189}
PAPERS_BYTES = {"1000 values": 4.0 * 1000, "4096 values": 4.0 * 4096}
"""The paper's dimensions in single precision; its figures name no other numbers in the text."""


class Figures:
    """Draws figures into a folder; each method returns the files' names."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def curves(self, each: EvaluationSet, methods: Mapping[str, Measured]) -> list[str]:
        """Draw precision over recall of all pairs and of best matches (Figures 5 to 8)."""
        dataset = _typical(each, next(iter(methods.values())))
        found = {name: m.similarities[dataset.name] for name, m in methods.items()}
        title = each.name if len(each.datasets) == 1 else f"{each.name}: {dataset.name}"
        slug = each.name.replace(" ", "_")
        pairs = {name: pair_curve(values, dataset) for name, values in found.items()}
        best = {name: best_match_curve(values, dataset) for name, values in found.items()}
        return [
            self._write(f"pairs-{slug}.png", precision_recall(pairs, f"{title}, all pairs")),
            self._write(f"best-{slug}.png", precision_recall(best, f"{title}, best matches")),
        ]

    def distances(self, dataset: PlaceDataset, methods: Mapping[str, Similarities]) -> str:
        """Draw distances beside the truth (Figure 11)."""
        return self._write(f"distances-{dataset.name}.png", heat_maps(dataset, methods, columns=2))

    def dimensions(self, series: Mapping[str, Mapping[int, list[float]]]) -> str:
        """Draw average precision over the dimension (Figure 12)."""
        return self._write("dimensions.svg", dimension_comparison(series))

    def costs(self, costs: Mapping[str, Cost]) -> list[str]:
        """Draw what embedding, comparing and keeping take (Figures 13 to 15)."""
        embed = {name: cost.embed_ms for name, cost in costs.items()}
        compare = {name: cost.compare_ms for name, cost in costs.items()}
        size = {name: float(cost.embedding_bytes) for name, cost in costs.items()}
        return [
            self._write("extraction.svg", bars(embed, "ms per image", PAPERS_EXTRACTION_MS)),
            self._write("comparison.svg", bars(compare, "ms per comparison", PAPERS_COMPARISON_MS)),
            self._write("sizes.svg", bars(size, "bytes per image", PAPERS_BYTES)),
        ]

    def way(self, name: str, dataset: PlaceDataset, similarities: Similarities) -> str:
        """Draw the recognised places on the way (Figure 9), at the threshold of most recall."""
        curve = best_match_curve(similarities, dataset)
        matches = best_matches(similarities, dataset)
        figure = recognised_places(dataset, matches, curve.balanced_threshold, name)
        return self._write(f"way-{name.replace(' ', '_')}.svg", figure)

    def _write(self, name: str, figure: Figure) -> str:
        save = svg if name.endswith(".svg") else png
        write_atomically(self._folder / name, save(figure))
        return name


def _typical(each: EvaluationSet, method: Measured) -> PlaceDataset:
    """Return the dataset that stands for a set of several, whose curves cannot be averaged.

    On it the method's average precision is nearest to its mean over all.
    """

    def off(dataset: PlaceDataset) -> float:
        own = pair_curve(method.similarities[dataset.name], dataset).area
        return abs(own - method.scores[each.name].average_precision)

    return min(each.datasets, key=off)

# SPDX-License-Identifier: Apache-2.0
"""The places that were recognised, on the way that the camera took (Figure 9)."""

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation.drawing import RIGHT, SOFT, WIDTH_IN, WRONG, canvas
from placerec.evaluation.precision_recall import BestMatches


def recognised_places(
    dataset: PlaceDataset, matches: BestMatches, threshold: float, title: str = ""
) -> Figure:
    """Draw the way, and a line between each query and the reference that it was taken for.

    Args:
        dataset: with positions.
        matches: of a method on it.
        threshold: similarity from which a match counts as recognised.
        title: such as the method's name.

    Raises:
        RecognizerError: nobody knows where the images were taken.
    """
    if dataset.positions_m is None:
        raise RecognizerError(f"{dataset.name} does not say where its images were taken")
    across, up = sorted(np.argsort(-np.ptp(dataset.positions_m, axis=0), kind="stable")[:2])
    plane_m = dataset.positions_m[:, [across, up]]
    width, height = np.maximum(np.ptp(plane_m, axis=0), 1e-3)
    with canvas(1.4 + 0.8 * WIDTH_IN * float(np.clip(height / width, 0.4, 1.1))) as figure:
        axes = figure.add_subplot(title=title)
        axes.set_aspect("equal", adjustable="datalim")
        ways = {"query": (dataset.queries, "-"), "reference": (dataset.references, "--")}
        if np.array_equal(dataset.queries, dataset.references):
            ways = {"way": (dataset.queries, "-")}
        for label, (images, dashes) in ways.items():
            axes.plot(*plane_m[images].T, color=SOFT, linestyle=dashes, linewidth=1.2, label=label)
        kept = matches.similarities >= threshold
        ends = np.stack(
            [dataset.queries[matches.queries], dataset.references[matches.references]], axis=1
        )
        for name, right, colour in (("right", True, RIGHT), ("wrong", False, WRONG)):
            pairs = plane_m[ends[kept & (matches.are_right == right)]]
            if len(pairs):
                label = f"{name} ({len(pairs)})"
                axes.add_collection(
                    LineCollection(pairs, colors=colour, linewidths=0.9, alpha=0.7, label=label)
                )
        axes.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)")
        figure.legend(loc="outside lower left", ncols=4)
    return figure

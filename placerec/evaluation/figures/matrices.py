# SPDX-License-Identifier: Apache-2.0
"""How far apart images are to a method, beside which of them show one place (Figure 11)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset
from placerec.evaluation.drawing import GRID, SOFT, canvas

_MAX_CELLS = 400
"""A matrix with more rows or columns is thinned out before it is drawn."""
_NEAR_TO_FAR = "YlGnBu_r"
_FAINT, _STRONG = 0.01, 0.99
"""Shares of the distances between which the colours change."""
_SAME, _DIFFERENT, _UNKNOWN = "#081d58", "#ffffd9", GRID
_MAP_SIZE_IN = 3.4


def heat_maps(
    dataset: PlaceDataset, similarities: Mapping[str, Similarities], columns: int = 3
) -> Figure:
    """Draw the truth and, beside it, each method's (Q, R) distances; bright is far apart."""
    count = 1 + len(similarities)
    columns = min(columns, count)
    rows = -(-count // columns)
    with canvas(rows * (_MAP_SIZE_IN + 0.3), columns * _MAP_SIZE_IN, "compressed") as figure:
        places = iter(figure.subplots(rows, columns, squeeze=False).flat)
        _paint_truth(next(places), dataset)
        for name, values in similarities.items():
            _paint_distances(next(places), name, values, dataset)
        for empty in places:
            empty.set_axis_off()
    return figure


def truth_map(dataset: PlaceDataset) -> Figure:
    """Draw which queries and references show one place."""
    with canvas(_MAP_SIZE_IN + 0.3, _MAP_SIZE_IN) as figure:
        _paint_truth(figure.add_subplot(), dataset)
    return figure


def distance_map(name: str, similarities: Similarities, dataset: PlaceDataset) -> Figure:
    """Draw a method's (Q, R) distances; bright is far apart."""
    with canvas(_MAP_SIZE_IN + 0.3, _MAP_SIZE_IN) as figure:
        _paint_distances(figure.add_subplot(), name, similarities, dataset)
    return figure


def _paint_truth(axes: Axes, dataset: PlaceDataset) -> None:
    kinds = np.where(dataset.comparable, np.where(dataset.same_place, 0, 1), 2)
    count = int(kinds.max()) + 1
    colours = ListedColormap((_SAME, _DIFFERENT, _UNKNOWN)[:count])
    bar = _paint(axes, "ground truth", kinds, colours, (-0.5, count - 0.5))
    bar.set_ticks(range(count), labels=("same place", "different", "not compared")[:count])
    bar.ax.tick_params(length=0)


def _paint_distances(
    axes: Axes, name: str, similarities: Similarities, dataset: PlaceDataset
) -> None:
    distances = np.sqrt(np.maximum(2.0 - 2.0 * similarities.astype(np.float64), 0.0))
    low, high = np.quantile(distances[dataset.comparable], [_FAINT, _STRONG])
    bar = _paint(axes, name, distances, _NEAR_TO_FAR, (low, max(high, low + 1e-9)))
    bar.set_label("distance", fontsize=8.5)
    bar.ax.locator_params(nbins=4)


def _paint(
    axes: Axes,
    title: str,
    values: NDArray[np.number[Any]],
    colours: str | ListedColormap,
    limits: tuple[float, float],
) -> Colorbar:
    """Draw a matrix with a bar of its colours below, and return the bar."""
    rows, columns = values.shape
    image = axes.imshow(
        values[:: -(-rows // _MAX_CELLS), :: -(-columns // _MAX_CELLS)],
        cmap=colours,
        clim=limits,
        interpolation="none",
        aspect="auto",
        extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
    )
    axes.grid(visible=False)
    axes.set_box_aspect(float(np.clip(rows / columns, 0.4, 1.0)))
    axes.set(title=title, xlabel="reference", ylabel="query")
    axes.locator_params(nbins=5)
    bar = axes.figure.colorbar(image, ax=axes, location="bottom", aspect=30)
    bar.ax.tick_params(labelsize=8.5)
    bar.outline.set_edgecolor(SOFT)
    return bar

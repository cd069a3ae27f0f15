# SPDX-License-Identifier: Apache-2.0
"""Figures as in the paper: data in, matplotlib figures out; `svg` and `png` make files of them."""

from placerec.evaluation.drawing import png, svg
from placerec.evaluation.figures.curves import bars, dimension_comparison, precision_recall
from placerec.evaluation.figures.matrices import distance_map, heat_maps, truth_map
from placerec.evaluation.figures.path import recognised_places

__all__ = [
    "bars",
    "dimension_comparison",
    "distance_map",
    "heat_maps",
    "png",
    "precision_recall",
    "recognised_places",
    "svg",
    "truth_map",
]

# SPDX-License-Identifier: Apache-2.0
"""Methods compared: precision and recall (Figures 5 to 8), dimension (12), cost (13-15)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from placerec.evaluation.drawing import COLOURS, SOFT, canvas, line_styles
from placerec.evaluation.precision_recall import Curve

_BAR_HEIGHT_IN, _BARS_FRAME_IN = 0.3, 0.8
_LINE_HEIGHT_IN, _LINES_FRAME_IN = 0.22, 3.6
"""A line of the legend, and all the rest."""
_NUMBER_SPACE = 6.0
"""The axis ends at so many times the longest bar, so that its number fits in behind it."""


def bars(
    values: Mapping[str, float], label: str, paper: Mapping[str, float] | None = None
) -> Figure:
    """Draw a bar per method, on a logarithmic scale, with its number behind it.

    Args:
        values: what was measured, all above 0.
        label: the quantity and its unit.
        paper: figures of the paper, drawn below in grey.
    """
    measured = [(name, value, COLOURS[0]) for name, value in values.items()]
    published = [(f"paper: {name}", value, SOFT) for name, value in (paper or {}).items()]
    every = measured + published
    with canvas(_BARS_FRAME_IN + _BAR_HEIGHT_IN * len(every)) as figure:
        axes = figure.add_subplot(xlabel=label, xscale="log")
        names, lengths, colours = zip(*every, strict=True)
        drawn = axes.barh(range(len(every)), lengths, color=colours, height=0.65)
        numbers = [f"{x:,.0f}" if x >= 100.0 else f"{x:.3g}" for x in lengths]
        axes.bar_label(drawn, numbers, padding=3, fontsize=9)
        axes.set_yticks(range(len(every)), names)
        axes.tick_params("y", length=0)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlim(min(lengths) / _NUMBER_SPACE, max(lengths) * _NUMBER_SPACE)
    return figure


def precision_recall(curves: Mapping[str, Curve], title: str = "") -> Figure:
    """Draw precision over recall, a line per method; the legend tells the area below each."""
    with canvas(_LINES_FRAME_IN + _LINE_HEIGHT_IN * len(curves)) as figure:
        axes = figure.add_subplot(xlabel="recall", ylabel="precision", title=title)
        for (name, curve), (colour, dashes) in zip(curves.items(), line_styles(), strict=False):
            # From recall 0 on: the first threshold recognises several at once where they tie.
            recall = np.append(0.0, curve.recall)
            precision = np.append(curve.precision[:1], curve.precision)
            label = f"{name}  {curve.area:.3f}"
            axes.plot(recall, precision, color=colour, linestyle=dashes, label=label)
        axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.02))
        figure.legend(loc="outside lower left")
    return figure


def dimension_comparison(series: Mapping[str, Mapping[int, Sequence[float]]]) -> Figure:
    """Draw average precision over the dimension of the embedding, a line per method.

    Args:
        series: by method and by dimension, the average precision of each repetition (seed); the
            line goes through their means, the bars from the least to the largest.
    """
    with canvas(_LINES_FRAME_IN + _LINE_HEIGHT_IN * len(series)) as figure:
        axes = figure.add_subplot(xlabel="dimension", ylabel="average precision", xscale="log")
        for (name, values), (colour, dashes) in zip(series.items(), line_styles(), strict=False):
            dimensions = sorted(values)
            runs = [np.array(values[dimension]) for dimension in dimensions]
            means = np.array([run.mean() for run in runs])
            spread = [means - [run.min() for run in runs], [run.max() for run in runs] - means]
            look = f"o{dashes}"
            axes.errorbar(
                dimensions,
                means,
                spread,
                fmt=look,
                color=colour,
                markersize=4,
                capsize=3,
                label=name,
            )
        every = sorted({dimension for values in series.values() for dimension in values})
        axes.set_xticks(every, [str(dimension) for dimension in every])
        axes.minorticks_off()
        axes.set_ylim(bottom=0.0)
        figure.legend(loc="outside lower left")
    return figure

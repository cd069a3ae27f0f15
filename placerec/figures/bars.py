# SPDX-License-Identifier: Apache-2.0
"""What methods cost, as bars (Figures 13 to 15)."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from placerec.figures.canvas import COLOURS, SOFT, canvas

BAR_HEIGHT_IN, FRAME_HEIGHT_IN = 0.3, 0.8
ROOM = 6.0
"""The axis ends at so many times the longest bar, for the number behind it."""


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
    with canvas(FRAME_HEIGHT_IN + BAR_HEIGHT_IN * len(every)) as figure:
        axes = figure.add_subplot(xlabel=label, xscale="log")
        names, lengths, colours = zip(*every, strict=True)
        drawn = axes.barh(range(len(every)), lengths, color=colours, height=0.65)
        axes.bar_label(drawn, [_number(length) for length in lengths], padding=3, fontsize=9)
        axes.set_yticks(range(len(every)), names)
        axes.tick_params("y", length=0)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlim(min(lengths) / ROOM, max(lengths) * ROOM)
    return figure


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"

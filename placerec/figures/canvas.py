# SPDX-License-Identifier: Apache-2.0
"""The look that all figures have in common, and figures as bytes."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle, product
from typing import Literal

import matplotlib as mpl
from matplotlib.figure import Figure

INK, SOFT, GRID = "#20242a", "#7a808a", "#d9dde3"
RIGHT, WRONG = "#0a64b4", "#c01878"
COLOURS = ("#0a64b4", "#c4600a", "#1a8a5a", "#c01878", "#7a5fc0", "#8a6a40", "#2aa0b8", "#20242a")
DASHES = ("-", "--", ":", "-.")
WIDTH_IN = 5.0
"""Narrow, so that the writing stays legible where a page shrinks it to a phone's width."""

_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "placerec",
    "font.size": 10.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "axes.titlesize": 10.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.2,
    "figure.dpi": 110,
}


@contextmanager
def canvas(
    height_in: float,
    width_in: float = WIDTH_IN,
    layout: Literal["constrained", "compressed"] = "constrained",
) -> Iterator[Figure]:
    """Yield an empty figure; what is drawn on it meanwhile has the common look."""
    with mpl.rc_context(_STYLE):
        yield Figure(figsize=(width_in, height_in), layout=layout)


def line_styles() -> Iterator[tuple[str, str]]:
    """Yield colour and dashes of one line after the other, different as long as can be."""
    return ((colour, dashes) for dashes, colour in cycle(product(DASHES, COLOURS)))


def svg(figure: Figure) -> bytes:
    """Return a figure as an SVG file; the same figure, the same bytes."""
    return _save(figure, "svg", {"Date": None})


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file; the same figure, the same bytes."""
    return _save(figure, "png", {"Software": None})


def _save(figure: Figure, kind: str, metadata: dict[str, None]) -> bytes:
    buffer = io.BytesIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(buffer, format=kind, metadata=metadata)
    return buffer.getvalue()

# SPDX-License-Identifier: Apache-2.0
"""The one look of all figures, and figures as files."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle, product
from typing import Any, Literal

import matplotlib as mpl
from matplotlib.figure import Figure

INK, SOFT, GRID = "#20242a", "#7a808a", "#d0d4da"
RIGHT, WRONG = "#0a64b4", "#c01878"
BEFORE, AFTER, TRUTH = "#c4600a", RIGHT, SOFT
COLOURS = (RIGHT, BEFORE, "#1a8a5a", WRONG, "#7a5fc0", "#8a6a40", "#2aa0b8", INK)
_DASHES = ("-", "--", ":", "-.")
WIDTH_IN = 5.0
"""Narrow, so that the writing stays legible where a page shrinks it to a phone's width."""

_STYLE = {
    "svg.fonttype": "none",
    "font.size": 10.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
    "axes.titlesize": 10.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.2,
    "path.simplify_threshold": 0.3,
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
    return ((colour, dashes) for dashes, colour in cycle(product(_DASHES, COLOURS)))


def svg(figure: Figure) -> bytes:
    """Return a figure as an SVG file; the same figure, the same bytes."""
    return _save(figure, "svg", metadata={"Date": None})


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file; the same figure, the same bytes."""
    return _save(figure, "png", dpi=110, metadata={"Software": None})


def _save(figure: Figure, kind: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    with mpl.rc_context({**_STYLE, "svg.hashsalt": "placerec"}):
        figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()

# SPDX-License-Identifier: Apache-2.0
"""The one look of all figures; figures as files, and inside a page, whose colours they take."""

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from itertools import cycle, product
from typing import Any, Literal

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, SOFT, GRID = "#20242a", "#7a808a", "#d0d4da"
RIGHT, WRONG = "#0a64b4", "#c01878"
BEFORE, AFTER, TRUTH, LOST = "#c4600a", RIGHT, SOFT, "#8a6a40"
WITHOUT = "#1a8a5a"  # what would be without loops
COLOURS = (RIGHT, BEFORE, WITHOUT, WRONG, "#7a5fc0", LOST, "#2aa0b8", INK)
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

# Inside a page these become its CSS variables, so that one drawing suits light and dark.
_CSS = {
    INK: "var(--ink)",
    GRID: "var(--line)",
    BEFORE: "var(--before)",
    AFTER: "var(--after)",
    TRUTH: "var(--truth)",
    WRONG: "var(--wrong)",
    WITHOUT: "var(--without)",
    LOST: "var(--lost)",
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


def draw(name: str, alt: str, paint: Callable[[Axes], None], height_in: float = 3.8) -> Markup:
    """Return a drawing as an SVG element: `paint` fills the axes, labelled artists the legend.

    `name` must be unique on the page: it keeps the drawings' inner references apart.
    """
    with canvas(height_in) as figure:
        axes = figure.add_subplot()
        paint(axes)
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside upper left", ncols=3)
    text = _save(figure, "svg", name, transparent=True, metadata={"Date": None}).decode()
    # Strip the file to what belongs inside a page.
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # never referred to, and repeated in each drawing
    text = re.sub(r' (?:width|height)="[\d.]+pt"', "", text, count=2)
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", text)
    for colour, variable in _CSS.items():
        text = text.replace(colour, variable)
    label = escape(alt, quote=True)
    return Markup(text.replace("<svg", f'<svg role="img" aria-label="{label}"', 1))


def _save(figure: Figure, kind: str, salt: str = "placerec", **options: Any) -> bytes:
    buffer = io.BytesIO()
    with mpl.rc_context({**_STYLE, "svg.hashsalt": salt}):
        figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()

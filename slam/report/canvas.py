# SPDX-License-Identifier: Apache-2.0
"""Matplotlib drawings as inline SVG that takes its colours and font from the page around it."""

import re
from collections.abc import Callable
from html import escape
from io import StringIO

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, GRID = "#20242a", "#d0d4da"
BEFORE, AFTER, TRUTH, WRONG, LOST = "#c4600a", "#0a64b4", "#7a808a", "#c01878", "#8a6a40"

# Colours become CSS variables, so that one drawing suits light and dark pages.
_CSS = {
    INK: "var(--ink)",
    GRID: "var(--line)",
    BEFORE: "var(--before)",
    AFTER: "var(--after)",
    TRUTH: "var(--truth)",
    WRONG: "var(--wrong)",
    LOST: "var(--lost)",
}

_STYLE = {
    "svg.fonttype": "none",
    "font.size": 10.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
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

WIDTH_IN = 5.0
"""Narrow, so that the writing stays legible where the page shrinks it to a phone's width."""

Paint = Callable[[Axes], None]


def draw(name: str, alt: str, paint: Paint, height_in: float = 3.8) -> Markup:
    """Return a drawing as an SVG element: `paint` fills the axes, labelled artists the legend.

    `name` must be unique on the page: it keeps the drawings' inner references apart.
    """
    with mpl.rc_context({**_STYLE, "svg.hashsalt": name}):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        axes = figure.add_subplot()
        paint(axes)
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside upper left", ncols=3)
        text = StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    return _inline(text.getvalue(), alt)


def _inline(svg: str, alt: str) -> Markup:
    """Strip a stand-alone SVG file to what belongs inside a page."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'<g id="[^"]*"', "<g", svg)  # never referred to, and repeated in each drawing
    svg = re.sub(r' (?:width|height)="[\d.]+pt"', "", svg, count=2)
    svg = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", svg)
    for colour, variable in _CSS.items():
        svg = svg.replace(colour, variable)
    label = escape(alt, quote=True)
    return Markup(svg.replace("<svg", f'<svg role="img" aria-label="{label}"', 1))

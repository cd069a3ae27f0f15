# SPDX-License-Identifier: Apache-2.0
"""Drawings that need no script, for paper and for browsers without WebGL: SVG in the page."""

from dataclasses import dataclass
from html import escape

import numpy as np
from markupsafe import Markup

from slam.output.decision import ACCEPTED, FALSE, Decision
from slam.output.report.page_data import Curve
from slam.output.report.paths import Paths, at_keyframes
from slam.types import FloatArray, IntArray

_WIDTH, _HEIGHT = 560.0, 360.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 10.0, 30.0, 42.0
_MOST_POINTS = 1500  # of a line


@dataclass(frozen=True)
class _Axes:
    """A rectangle of the drawing, and the numbers at its edges."""

    low: FloatArray
    high: FloatArray

    def at(self, points: FloatArray) -> FloatArray:
        """Return (N, 2) places on the drawing of (N, 2) points."""
        size = np.array([_WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM])
        share = (points - self.low) / (self.high - self.low)
        return np.asarray([_LEFT, _HEIGHT - _BOTTOM] + share * size * [1.0, -1.0])

    def grid(self, labels: tuple[str, str]) -> list[str]:
        """Return lines at round numbers, these numbers, and what they are."""
        parts = []
        for x in _round_numbers(self.low[0], self.high[0]):
            u = self.at(np.array([x, self.low[1]]))[0]
            parts.append(f'<path class="grid" d="M{u:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
            parts.append(_text(u, _HEIGHT - _BOTTOM + 15, f"{x:g}", "middle"))
        for y in _round_numbers(self.low[1], self.high[1]):
            v = self.at(np.array([self.low[0], y]))[1]
            parts.append(f'<path class="grid" d="M{_LEFT} {v:.1f}H{_WIDTH - _RIGHT}"/>')
            parts.append(_text(_LEFT - 6, v + 4, f"{y:g}", "end"))
        parts.append(_text((_LEFT + _WIDTH) / 2, _HEIGHT - 8, labels[0], "middle"))
        middle = (_TOP + _HEIGHT - _BOTTOM) / 2
        turned = f' transform="rotate(-90 12 {middle})"'
        return [*parts, _text(12, middle, labels[1], "middle", turned)]

    def line(self, points: FloatArray, breaks: IntArray, look: str) -> str:
        """Return a line through (N, 2) points, interrupted where they are NaN and at breaks."""
        pieces = []
        for piece in np.split(self.at(points), breaks):
            cuts = np.flatnonzero(~np.isfinite(piece).all(axis=1))
            for part in np.split(piece, cuts):
                known = part[np.isfinite(part).all(axis=1)]
                if len(known):
                    pieces.append("M" + "L".join(f"{u:.1f} {v:.1f}" for u, v in known.tolist()))
        return f'<path class="line" d="{"".join(pieces)}" {look}/>'


def path_from_above(paths: Paths, loops: list[Decision]) -> Markup:
    """Draw odometry, the corrected path and the truth, drift enlarged, with the accepted loops."""
    axis = int(np.argmax(np.abs(paths.up)))
    plane = [(axis + 1) % 3, (axis + 2) % 3][:: 1 if paths.up[axis] > 0.0 else -1]
    odometry, corrected, truth = (
        paths.enlarged(points, paths.enlargement)[:, plane]
        for points in (paths.odometry[:, :3, 3], paths.corrected[:, :3, 3], paths.truth_m)
    )
    shown = np.concatenate([odometry, corrected, truth])
    axes = _Axes(*_equal(shown[np.isfinite(shown).all(axis=1)]))
    across, upwards = (f"{'xyz'[i]} (m)" for i in plane)
    parts = axes.grid((across, upwards))
    ends = at_keyframes(corrected, paths.keyframe_frames)
    for kind, colour in ((ACCEPTED, "after"), (FALSE, "wrong")):
        pairs = [[ends[each.match.id], ends[each.query.id]] for each in loops if each.kind == kind]
        if pairs:
            look = f'style="stroke:var(--{colour})" stroke-width="0.7" opacity="0.5"'
            starts = np.arange(2, 2 * len(pairs), 2)
            parts.append(axes.line(np.array(pairs).reshape(-1, 2), starts, look))
    every = np.arange(0, len(corrected), -(-len(corrected) // _MOST_POINTS) or 1)
    breaks = paths.breaks_among(every)
    legend = [("odometry", "before"), ("with loops", "after")]
    for points, colour, look in (
        (truth, "truth", 'stroke-width="4" opacity="0.5"'),
        (odometry, "before", 'stroke-width="1.3" stroke-dasharray="5 2"'),
        (corrected, "after", 'stroke-width="1.7"'),
    ):
        parts.append(axes.line(points[every], breaks, f'style="stroke:var(--{colour})" {look}'))
    if paths.in_truth_frame:
        legend.insert(0, ("ground truth", "truth"))
    for u, v in axes.at(corrected[paths.session_starts]).tolist():
        parts.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="4" style="fill:var(--ink)"/>')
    return _drawing("The camera's path, seen from above", parts, legend)


def drift_along_time(paths: Paths, curves: list[Curve]) -> Markup:
    """Draw position errors, or without ground truth how far loops moved each frame."""
    highest = max((np.nanmax(100 * each.lengths_m, initial=0.0) for each in curves), default=0.0)
    last_s = paths.times_s[-1] if len(paths.times_s) else 0.0
    axes = _Axes(np.zeros(2), np.array([max(last_s, 1e-3), max(1.05 * highest, 1e-3)]))
    what = "position error (cm)" if paths.in_truth_frame else "moved by loops (cm)"
    parts = axes.grid(("time (s)", what))
    for lost_s in paths.lost_s.tolist():
        u = axes.at(np.array([lost_s, 0.0]))[0]
        parts.append(f'<path d="M{u:.1f} {_TOP}V{_HEIGHT - _BOTTOM}" style="stroke:var(--lost)"/>')
    every = np.arange(0, len(paths.times_s), -(-len(paths.times_s) // _MOST_POINTS) or 1)
    breaks = paths.breaks_among(every)
    for curve in curves:
        points = np.column_stack([paths.times_s, 100 * curve.lengths_m])[every]
        look = f'style="stroke:var(--{curve.colour})" stroke-width="1.4"'
        parts.append(axes.line(points, breaks, look))
    return _drawing("Drift along time", parts, [(each.name, each.colour) for each in curves])


def _equal(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the edges of axes that show all of the points, a metre as long on both."""
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(2), np.ones(2))
    middle = (low + high) / 2
    size = np.array([_WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM])
    per_px = max(float(((high - low) / size).max()) * 1.06, 1e-6)
    return middle - per_px * size / 2, middle + per_px * size / 2


def _round_numbers(low: float, high: float) -> list[float]:
    """Return some four to nine round numbers between two others."""
    step = 10.0 ** np.floor(np.log10((high - low) / 4))
    step *= next(k for k in (5, 2, 1) if k * step <= (high - low) / 4)
    numbers = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    return [float(f"{number:.6g}") + 0.0 for number in numbers]


def _text(u: float, v: float, words: str, anchor: str, more: str = "") -> str:
    return f'<text x="{u:.1f}" y="{v:.1f}" text-anchor="{anchor}"{more}>{escape(words)}</text>'


def _drawing(alt: str, parts: list[str], legend: list[tuple[str, str]]) -> Markup:
    u = _LEFT
    for name, colour in legend:
        style = f'style="stroke:var(--{colour})" stroke-width="3"'
        parts += [f'<path d="M{u} 14h18" {style}/>', _text(u + 23, 18, name, "start")]
        u += 40 + 7.2 * len(name)
    return Markup(
        f'<svg role="img" aria-label="{escape(alt)}" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}">'
        f"{''.join(parts)}</svg>"
    )

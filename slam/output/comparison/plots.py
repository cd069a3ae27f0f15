# SPDX-License-Identifier: Apache-2.0
"""Drawings of compared trajectories: from above, and their errors over time and over lengths."""

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.axes import Axes

from placerec.errors import printable
from placerec.evaluation.drawing import INK, TRUTH, WIDTH_IN, canvas, line_styles, png, svg
from slam.evaluation.comparison import Comparison
from slam.evaluation.pose_errors import root_mean_square
from slam.output.comparison.figures import in_brief
from slam.types import FloatArray

_GAP_FACTOR = 5.0  # poses further apart than so many median steps are not joined by a line
_LEAST_IN, _MOST_IN, _LEGEND_LINE_IN = 2.2, 6.0, 0.22


def plots(compared: Mapping[str, Comparison], *, has_times: bool) -> dict[str, bytes]:
    """Return SVG and PNG files by name, of comparisons with one truth, by the estimate's name."""
    longest = max(compared.values(), key=lambda each: each.association.matched)
    extent_m = np.ptp(longest.truth_m, axis=0)
    across, up = sorted(int(axis) for axis in np.argsort(-extent_m, kind="stable")[:2])
    ratio = extent_m[up] / max(extent_m[across], 1e-9)

    def paths(axes: Axes) -> None:
        axes.set_aspect("equal", adjustable="datalim")
        truth = _broken(longest.times_s, longest.truth_m)[1]
        axes.plot(truth[:, across], truth[:, up], color=TRUTH, lw=3.0, alpha=0.55, label="truth")
        for (name, each), (colour, dashes) in zip(compared.items(), line_styles(), strict=False):
            path = _broken(each.times_s, each.aligned_m)[1]
            label = f"{name}: {in_brief(each)}"
            axes.plot(path[:, across], path[:, up], color=colour, ls=dashes, lw=1.3, label=label)
        axes.plot(*longest.truth_m[0, [across, up]], "o", color=INK, ms=5, label="start")
        axes.set_xlabel(f"{'xyz'[across]} (m)")
        axes.set_ylabel(f"{'xyz'[up]} (m)")

    def errors(axes: Axes) -> None:
        start = min(each.times_s[0] for each in compared.values())
        for (name, each), (colour, dashes) in zip(compared.items(), line_styles(), strict=False):
            times, lengths = _broken(each.times_s - start, each.ape_m)
            label = f"{name}: {in_brief(each)}"
            axes.plot(times, lengths, color=colour, ls=dashes, lw=1.2, label=label)
        axes.set_xlabel("time (s)" if has_times else "row")
        axes.set_ylabel("APE (m)")
        axes.set_ylim(bottom=0)

    def by_length(axes: Axes) -> None:
        for (name, each), (colour, dashes) in zip(compared.items(), line_styles(), strict=False):
            some = [errors for errors in each.by_length if len(errors.translation_m)]
            lengths_m = [errors.delta.amount for errors in some]
            rmse_m = [root_mean_square(errors.translation_m) for errors in some]
            label = f"{name}: {in_brief(each)}"
            axes.plot(lengths_m, rmse_m, "o", color=colour, ls=dashes, ms=3.5, lw=1.2, label=label)
        axes.set_xscale("log")
        ticks_m = sorted({e.delta.amount for each in compared.values() for e in each.by_length})
        axes.set_xticks(ticks_m, [f"{tick_m:g}" for tick_m in ticks_m])
        axes.minorticks_off()
        axes.set_xlabel("length of the way (m), all pairs to a tenth")
        axes.set_ylabel("RPE, RMSE (m)")
        axes.set_ylim(bottom=0)

    height_in = float(np.clip(0.85 * WIDTH_IN * ratio + 0.8, _LEAST_IN, _MOST_IN))
    lines = len(compared)
    return {
        **_drawn("trajectories", paths, height_in, lines + 2),
        **_drawn("error_over_time", errors, 3.0, lines),
        **_drawn("rpe_over_length", by_length, 3.0, lines),
    }


def _drawn(
    name: str, paint: Callable[[Axes], None], height_in: float, lines: int
) -> dict[str, bytes]:
    with canvas(height_in + _LEGEND_LINE_IN * lines) as figure:
        axes = figure.add_subplot()
        paint(axes)
        drawn = axes.lines
        # Names of files are set later, as they are: matplotlib would leave out a label that begins
        # with _, and take what is between two $ for a formula.
        legend = figure.legend(drawn, [""] * len(drawn), loc="outside upper left", fontsize=8.5)
        for text, line in zip(legend.get_texts(), drawn, strict=True):
            text.set_parse_math(False)
            text.set_text(printable(str(line.get_label())))
        return {f"{name}.svg": svg(figure), f"{name}.png": png(figure)}


def _broken(times_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return times and values with NaN between poses that are far apart, to break the line."""
    steps_s = np.diff(times_s)
    if len(steps_s) == 0:
        return times_s, values
    cuts = np.flatnonzero(steps_s > _GAP_FACTOR * np.median(steps_s)) + 1
    return np.insert(times_s, cuts, np.nan), np.insert(values, cuts, np.nan, axis=0)

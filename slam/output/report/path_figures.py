# SPDX-License-Identifier: Apache-2.0
"""Drawings of where the camera went and how far from the truth."""

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from placerec.drawing import (
    AFTER,
    BEFORE,
    INK,
    LOST,
    TRUTH,
    WIDTH_IN,
    WITHOUT,
    WRONG,
    draw,
)
from slam.evaluation.drift import DriftReport
from slam.output.decision import ACCEPTED, FALSE, Decision
from slam.output.report.paths import SESSION_GAP_S, Paths, broken
from slam.result import SlamResult
from slam.types import FloatArray

_LOOP_COLOURS = {ACCEPTED: AFTER, FALSE: WRONG}


def path_view(paths: Paths, loops: list[Decision], plane: tuple[int, int]) -> Markup:
    """Draw the camera paths projected on two coordinate axes (0, 1, 2 for x, y, z)."""
    across, up = ("xyz"[axis] for axis in plane)

    def lines(times_s: FloatArray, points_m: FloatArray) -> FloatArray:
        return broken(times_s, points_m)[1][:, plane].T

    def paint(axes: Axes) -> None:
        axes.set_aspect("equal", adjustable="datalim")
        _draw_loops(axes, paths, loops, plane)
        if len(paths.truth_m):
            truth = lines(paths.truth_times_s, paths.truth_m)
            axes.plot(*truth, color=TRUTH, lw=3.2, alpha=0.55, label="ground truth")
        before = lines(paths.times_s, paths.before_m)
        axes.plot(*before, color=BEFORE, lw=1.3, ls=(0, (4, 1.5)), label="odometry")
        after = lines(paths.times_s, paths.after_m)
        axes.plot(*after, color=AFTER, lw=1.5, label="corrected")
        _mark_start_and_losses(axes, paths, plane)
        axes.set_xlabel(f"{across} (m)")
        axes.set_ylabel(f"{up} (m)")
        if up == "y" and not paths.in_truth_frame:  # the first camera's y axis points down
            axes.invert_yaxis()

    alt = f"Camera paths before and after loop closure, projected on the {across} and {up} axes"
    points = np.concatenate([paths.before_m, paths.after_m, paths.truth_m])
    width, height = np.ptp(points[:, plane], axis=0) if len(points) else (1.0, 1.0)
    height_in = float(1.0 + 0.84 * WIDTH_IN * np.clip(height / max(width, 1e-9), 0.35, 1.1))
    return draw(f"path-{across}{up}", alt, paint, height_in)


def _draw_loops(axes: Axes, paths: Paths, loops: list[Decision], plane: tuple[int, int]) -> None:
    gap = np.full((1, 3), np.nan)
    for kind, colour in _LOOP_COLOURS.items():
        pieces = []
        for loop in loops:
            if loop.kind == kind:
                pieces += [paths.keyframes_m[[loop.match.id, loop.query.id]], gap]
        if pieces:
            alpha = 0.5 if kind == ACCEPTED else 0.9
            line = np.concatenate(pieces)[:, plane].T
            axes.plot(*line, color=colour, lw=0.8, alpha=alpha, label=f"{kind} loop")


def _mark_start_and_losses(axes: Axes, paths: Paths, plane: tuple[int, int]) -> None:
    if len(paths.after_m) == 0:
        return
    starts = paths.after_m[paths.session_starts][:, plane].T
    axes.plot(*starts, "o", color=INK, ms=5, label="start" if len(starts[0]) == 1 else "starts")
    if len(paths.lost_s):
        last = np.unique((np.searchsorted(paths.times_s, paths.lost_s) - 1).clip(0))
        spots = paths.after_m[last][:, plane].T
        axes.plot(*spots, "x", color=LOST, ms=7, mew=2, label="tracking lost")


def error_over_time(
    paths: Paths, result: SlamResult, drift: DriftReport | None, loops: list[Decision]
) -> Markup:
    """Draw the position error along time: of the odometry, and in the end without and with loops.

    Without ground truth, `drift` None, draw how far loop closure moved each frame.
    """
    if drift is not None:
        what = "Position error along time, of the odometry and in the end without and with loops"
        label = "position error"
        curves = [
            (paths.elapsed_s(error.timestamps_s), error.position_errors_m, colour, name, width)
            for error, colour, name, width in (
                (drift.odometry, BEFORE, "odometry", 1.1),
                (drift.without_loops, WITHOUT, "without loops", 1.1),
                (drift.corrected, AFTER, "corrected", 1.6),
            )
        ]
    else:
        what, label = "How far loop closure moved each frame along time", "moved by loops"
        curves = [(paths.times_s, result.moved_by_loops_m, AFTER, "correction", 1.6)]

    def paint(axes: Axes) -> None:
        for times_s, lengths_m, colour, name, width in curves:
            times, lengths = broken(times_s, lengths_m)
            axes.plot(times, 100 * lengths, color=colour, lw=width, label=name)
        axes.set_ylabel(f"{label} (cm)")
        _mark_times(axes, paths, loops)

    return draw("error", f"{what}; triangles mark closed loops", paint)


def _mark_times(axes: Axes, paths: Paths, loops: list[Decision]) -> None:
    """Mark untracked frames, and put a tick at every keyframe that closed a loop."""
    later_starts = paths.session_starts_s[1:]
    axes.set_xlabel("time (s), without the breaks" if len(later_starts) else "time (s)")
    for start in later_starts:
        axes.axvline(start - 0.5 * SESSION_GAP_S, color=INK, lw=0.8, ls=":")
    axes.tick_params("x", pad=9)  # space for the triangles
    axes.set_ylim(bottom=0)
    if len(paths.lost_s):
        edge = axes.get_xaxis_transform()
        axes.vlines(paths.lost_s, 0, 1, color=LOST, lw=1.2, transform=edge, label="not tracked")
    for kind, colour in _LOOP_COLOURS.items():
        closed = [loop.query.timestamp_s for loop in loops if loop.kind == kind]
        if closed:
            times = np.unique(paths.elapsed_s(np.array(closed)))
            marks = axes.plot(times, 0 * times - 0.035, "^", color=colour, ms=5, clip_on=False)
            marks[0].set(transform=axes.get_xaxis_transform(), label=f"{kind} loop")

# SPDX-License-Identifier: Apache-2.0
"""The result of a run in a few plain sentences."""

from collections import Counter

import numpy as np

from slam.evaluation.drift import DriftReport
from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision
from slam.result import SlamResult

_NO_CHANGE = 0.02
"""Drift that changes by less than this share is called unchanged."""


def length(metres: float) -> str:
    """Return a length in the unit that people would say it in."""
    if not np.isfinite(metres):
        return "–"
    if metres < 0.01:
        return f"{1000 * metres:.1f} mm"
    return f"{100 * metres:.1f} cm" if metres < 1.0 else f"{metres:.2f} m"


def headline(result: SlamResult, drift: DriftReport | None, loops: list[Decision]) -> list[str]:
    """Return what happened, one sentence per fact, the most important first."""
    # Without any loop the graph still adjusts neighbouring keyframes to each other.
    is_closed = any(loop.attempt.rejection is None for loop in loops)
    subject = "Loop closure" if is_closed else "The pose graph, without any loop,"
    if drift is None:
        return [f"{subject} {_correction(result)}", _loops(drift, loops)]
    sentences = [f"{subject} {_drift(result, drift)}", _loops(drift, loops)]
    if min(drift.coverage, drift.after.matched_share) < 0.995:
        sentences.append(
            f"Ground truth covers {drift.coverage:.0%} of the sequence's time span; "
            "the figures say nothing about the rest."
        )
    return sentences


def _drift(result: SlamResult, drift: DriftReport) -> str:
    before, after = drift.before.ate_rmse_m, drift.after.ate_rmse_m
    frames = len(result.trajectory) + len(result.untracked_s)
    compared = f"ATE RMSE, {len(drift.after.timestamps_s)} of {frames} frames compared"
    if not np.isfinite(before) or abs(after - before) <= _NO_CHANGE * before:
        return f"left the drift at {length(after)} ({compared})."
    if after < before:
        return (
            f"cut the drift from {length(before)} to {length(after)} "
            f"({compared}, {1 - after / before:.0%} less)."
        )
    return f"made the drift worse: {length(before)} became {length(after)} ({compared})."


def _correction(result: SlamResult) -> str:
    shift = result.trajectory.T_world_cam[:, :3, 3] - result.odometry.T_world_cam[:, :3, 3]
    moved_m = np.linalg.norm(shift, axis=1) if len(shift) else np.zeros(1)
    return (
        f"moved the camera path by up to {length(moved_m.max())} ({length(moved_m.mean())} on "
        "average). No ATE can be given: there is no ground truth to compare this run with."
    )


def _loops(drift: DriftReport | None, loops: list[Decision]) -> str:
    if not loops:
        return "No earlier place looked like a candidate, so no loop was tried."
    kinds = Counter(loop.kind for loop in loops)
    kept = kinds[ACCEPTED] + kinds[FALSE]
    candidates = f"{len(loops)} candidate" + ("" if len(loops) == 1 else "s")
    text = f"{kept} of {candidates} {'was' if kept == 1 else 'were'} accepted"
    if kept and drift is not None:
        text += f", {kinds[FALSE] or 'none'} of them false"
        judged = sum(loop.truth is not None and loop.truth.is_false is not None for loop in loops)
        if judged < kept:
            text += f" (ground truth can judge {judged})"
    text += "."
    if outvoted := kinds[OUTVOTED]:
        text += f" The pose graph outvoted {outvoted} more that contradicted the rest."
    return text

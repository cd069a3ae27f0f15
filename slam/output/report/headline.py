# SPDX-License-Identifier: Apache-2.0
"""The result of a run in a few plain sentences."""

from collections import Counter

import numpy as np

from slam.evaluation.drift import DriftReport
from slam.output.report.decision import ACCEPTED, FALSE, OUTVOTED, Decision
from slam.result import SlamResult

NO_CHANGE = 0.02
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
    sentences = [_drift(result, drift, _subject(loops)), _loops(drift, loops)]
    if drift is not None and min(drift.coverage, drift.after.matched_share) < 0.995:
        sentences.append(
            f"Ground truth covers {drift.coverage:.0%} of the sequence's time span; "
            "the figures say nothing about the rest."
        )
    return sentences


def _subject(loops: list[Decision]) -> str:
    """Return what is to be praised or blamed: the graph also ties neighbouring keyframes."""
    is_closed = any(loop.rejection is None for loop in loops)
    return "Loop closure" if is_closed else "The pose graph, without any loop,"


def _drift(result: SlamResult, drift: DriftReport | None, subject: str) -> str:
    if drift is None:
        largest, mean = _movement(result)
        return (
            f"{subject} moved the camera path by up to {length(largest)} ({length(mean)} on "
            "average). No ATE can be given: there is no ground truth to compare this run with."
        )
    before, after = drift.before.ate_rmse_m, drift.after.ate_rmse_m
    tracked = len(result.trajectory) + len(result.untracked_s)
    compared = f"(ATE RMSE, {len(drift.after.timestamps_s)} of {tracked} frames compared)"
    if not np.isfinite(before) or abs(after - before) <= NO_CHANGE * before:
        return f"{subject} left the drift at {length(after)} {compared}."
    if after < before:
        return (
            f"{subject} cut the drift from {length(before)} to {length(after)} "
            f"{compared[:-1]}, {1 - after / before:.0%} less)."
        )
    return f"{subject} made the drift worse: {length(before)} became {length(after)} {compared}."


def _movement(result: SlamResult) -> tuple[float, float]:
    if len(result.trajectory) == 0:
        return 0.0, 0.0
    shift = result.trajectory.T_world_cam[:, :3, 3] - result.odometry.T_world_cam[:, :3, 3]
    distance = np.linalg.norm(shift, axis=1)
    return float(distance.max()), float(distance.mean())


def _loops(drift: DriftReport | None, loops: list[Decision]) -> str:
    if not loops:
        return "No earlier place looked like a candidate, so no loop was tried."
    kinds = Counter(loop.kind for loop in loops)
    kept = kinds[ACCEPTED] + kinds[FALSE]
    text = f"{kept} of {_count(len(loops), 'candidate')} {_was(kept)} accepted"
    if kept and drift is not None:
        text += f", {_falsehood(loops, kinds[FALSE])}"
    text += "."
    if out := kinds[OUTVOTED]:
        text += f" The pose graph outvoted {out} more that contradicted the rest."
    return text


def _falsehood(loops: list[Decision], false: int) -> str:
    kept = [loop for loop in loops if loop.kind in (ACCEPTED, FALSE)]
    known = sum(loop.truth is not None and loop.truth.is_false is not None for loop in kept)
    text = f"{false or 'none'} of them false"
    if known < len(kept):
        text += f" (ground truth can judge {known})"
    return text


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _was(number: int) -> str:
    return "was" if number == 1 else "were"

# SPDX-License-Identifier: Apache-2.0
"""The result of a run in a few plain sentences."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from slam.evaluation.drift import DriftReport
from slam.output.counterfactual import in_words, looked_again_in_words
from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision
from slam.result import GivenOdometry, SlamResult

_NO_CHANGE = 0.02
"""Drift that changes by less than this share is called unchanged."""


@dataclass(frozen=True)
class Figure:
    """One of the numbers that answer first: what it is of, itself, and what stands behind it."""

    name: str
    value: str
    note: str


def figures(
    result: SlamResult, drift: DriftReport | None, loops: list[Decision]
) -> tuple[Figure, Figure, Figure]:
    """Return the error, the loops and the frames."""
    kinds = Counter(loop.kind for loop in loops)
    kept = kinds[ACCEPTED] + kinds[FALSE]
    notes = []
    if judged := _judged(loops):
        of = "" if judged >= kept else f" of {judged} judged"
        notes.append(f"{kinds[FALSE] or 'none'}{of} false by ground truth")
    if kinds[OUTVOTED]:
        notes.append(f"{kinds[OUTVOTED]} more outvoted by the rest")
    tracked, frames = len(result.trajectory), len(result.trajectory) + len(result.untracked_s)
    count = len(result.keyframes)
    keyframes = f"{count} keyframe" + ("" if count == 1 else "s")
    if result.elapsed_s:
        per_frame = 1000.0 / max(frames, 1)
        keyframes += f", {per_frame * result.elapsed_s:.1f} ms per frame"
        compiling_ms = per_frame * (result.compiling_s or 0.0)
        if compiling_ms >= 0.05:
            keyframes += f", {compiling_ms:.1f} of them compiling"
    return (
        _error(result, drift),
        Figure("Loops accepted", f"{kept} of {len(loops)}", "; ".join(notes) or "candidates"),
        Figure("Frames tracked", f"{tracked} of {frames}", keyframes),
    )


def _judged(loops: list[Decision]) -> int:
    """Return of how many loops in use ground truth knows whether they are false."""
    used = (loop for loop in loops if loop.kind in (ACCEPTED, FALSE))
    return sum(loop.truth is not None and loop.truth.is_false is not None for loop in used)


def _error(result: SlamResult, drift: DriftReport | None) -> Figure:
    if drift is None:
        return Figure("Error (ATE RMSE)", "not known", "no ground truth to compare with")
    without, tracked = drift.without_loops.ate_rmse_m, drift.odometry.ate_rmse_m
    note = f"without loops {length(without)}, odometry {length(tracked)}"
    return Figure("Error (ATE RMSE)", length(drift.corrected.ate_rmse_m), note)


def length(metres: float) -> str:
    """Return a length in the unit that people would say it in."""
    if not np.isfinite(metres):
        return "–"
    unit, per_m = ("mm", 1000.0) if metres < 0.01 else ("cm", 100.0) if metres < 1.0 else ("m", 1.0)
    number = per_m * metres
    return f"{number:.{2 if number < 10.0 else 1}f} {unit}"


def headline(result: SlamResult, drift: DriftReport | None, loops: list[Decision]) -> list[str]:
    """Return what happened, one sentence per fact, the most important first.

    Loop closure is credited with what it changed in the adjusted map, and with nothing else.
    """
    is_closed = any(loop.attempt.rejection is None for loop in loops)
    given = [_given(result.given)] if result.given and result.given.verdict else []
    each = [sentence] if (sentence := in_words(loops, drift)) else []
    if again := looked_again_in_words(result, drift):
        each.insert(0, f"Loops were looked for again: {again}.")
    if drift is None:
        return [_correction(result, is_closed), _loops(drift, loops), *each, *given]
    adjustment = _adjustment(drift, "given odometry" if result.given else "odometry")
    sentences = [_drift(result, drift, is_closed), adjustment, _loops(drift, loops), *each, *given]
    if min(drift.coverage, drift.corrected.matched_share) < 0.995:
        sentences.append(
            f"Ground truth covers {drift.coverage:.0%} of the sequence's time span; "
            "the figures say nothing about the rest."
        )
    return sentences


def _drift(result: SlamResult, drift: DriftReport, is_closed: bool) -> str:
    without, after = drift.without_loops.ate_rmse_m, drift.corrected.ate_rmse_m
    frames = len(result.trajectory) + len(result.untracked_s)
    compared = f"ATE RMSE, {len(drift.corrected.timestamps_s)} of {frames} frames compared"
    if not is_closed:
        return f"No loop was closed; the drift is {length(after)} ({compared})."
    if _is_same(without, after):
        return (
            f"Loop closure changed nothing here: the drift is {length(after)} with loops and"
            f" {length(without)} without ({compared})."
        )
    if after < without:
        return (
            f"Loop closure cut the drift from {length(without)} (without loops) to {length(after)}"
            f" ({compared}, {1 - after / without:.0%} less)."
        )
    return (
        f"Loop closure made the drift worse: {length(without)} (without loops) became"
        f" {length(after)} ({compared})."
    )


def _given(given: GivenOdometry) -> str:
    return given.verdict[0].upper() + given.verdict[1:] + "."


def _adjustment(drift: DriftReport, odometry: str) -> str:
    before, after = drift.odometry.ate_rmse_m, drift.without_loops.ate_rmse_m
    if _is_same(before, after):
        return f"Adjusting the map, without loops, left the {odometry}'s drift at {length(before)}."
    verb = "cut" if after < before else "raised"
    return (
        f"Adjusting the map, without loops, {verb} the {odometry}'s drift from {length(before)} to"
        f" {length(after)}."
    )


def _is_same(before: float, after: float) -> bool:
    return not np.isfinite(before) or abs(after - before) <= _NO_CHANGE * before


def _correction(result: SlamResult, is_closed: bool) -> str:
    if not is_closed:
        return "No loop was closed, so none moved the camera path."
    moved_m = result.moved_by_loops_m
    return (
        f"Loop closure moved the camera path by up to {length(moved_m.max())}"
        f" ({length(moved_m.mean())} on average)."
    )


def _loops(drift: DriftReport | None, loops: list[Decision]) -> str:
    if not loops:
        return "No earlier place looked like a candidate, so no loop was tried."
    kinds = Counter(loop.kind for loop in loops)
    kept = kinds[ACCEPTED] + kinds[FALSE]
    candidates = f"{len(loops)} candidate" + ("" if len(loops) == 1 else "s")
    text = f"{kept} of {candidates} {'was' if kept == 1 else 'were'} accepted"
    if kept and drift is not None and drift.unjudged:
        text += f"; which of them are false is not known: {drift.unjudged}"
    elif kept and drift is not None:
        text += f", {kinds[FALSE] or 'none'} of them false"
        judged = _judged(loops)
        if judged < kept:
            text += f" (ground truth can judge {judged})"
    text += "."
    if outvoted := kinds[OUTVOTED]:
        text += f" The pose graph outvoted {outvoted} more that contradicted the rest."
    return text

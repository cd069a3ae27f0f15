# SPDX-License-Identifier: Apache-2.0
"""The short table that a run ends with in the terminal."""

import math
from pathlib import Path

from slam.drift import DriftReport
from slam.summary import summarise
from slam.types import Camera, SlamResult


def summary_table(result: SlamResult, drift: DriftReport | None, folder: Path) -> str:
    """Return the run in a few lines: what was tracked, which loops were closed, the drift."""
    summary = summarise(result, drift)
    tracked = len(result.trajectory)
    rows = [
        ("camera", _camera(result.camera)),
        ("frames", f"{tracked} of {tracked + len(result.untracked_s)} tracked"),
        ("keyframes", f"{len(result.keyframes)}"),
        ("recognizer", _recognizer(result)),
        ("loops", _loops(summary)),
    ]
    if drift is not None:
        before, after = drift.before, drift.after
        rows += [
            ("ATE", f"{before.ate_rmse_m:.4f} m -> {after.ate_rmse_m:.4f} m corrected"),
            (
                "",
                f"RMSE over {after.matched_share:.1%} of the tracked frames"
                f" (truth within {drift.tolerance_s * 1e3:.0f} ms, it covers {drift.coverage:.1%})",
            ),
            ("", "after SE(3) alignment, scale not adjusted"),
            ("RPE", _relative_error(drift)),
        ]
    if summary["frames_per_second"] is not None:
        rows.append(("pipeline", f"{summary['frames_per_second']:.1f} frames/s"))
    rows += [("warning", warning) for warning in result.warnings]
    rows.append(("report", str(folder / "report.html")))
    return "\n".join(f"{name:<10} {text}" for name, text in rows)


def _camera(camera: Camera) -> str:
    return (
        f"{camera.width}x{camera.height}, fx {camera.fx:g}, fy {camera.fy:g} px,"
        f" {camera.depth_scale:g} depth units per metre"
    )


def _recognizer(result: SlamResult) -> str:
    text = f"verifies from similarity {result.min_similarity:.3f}"
    if result.calibration is None:
        return f"{text}, without a certificate"
    certificate = result.calibration.certificate
    low, high = certificate.threshold_interval
    return (
        f"{text}, calibrated on {certificate.data} ({certificate.pairs} pairs;"
        f" tau {certificate.threshold:.3f}, {low:.3f} to {high:.3f})"
    )


def _relative_error(drift: DriftReport) -> str:
    before, after = drift.before, drift.after
    if math.isnan(before.rpe_translation_m) or math.isnan(after.rpe_translation_m):
        return f"unknown: no two compared frames are {drift.rpe_interval_s:g} s apart"
    return (
        f"{before.rpe_translation_m:.4f} m -> {after.rpe_translation_m:.4f} m,"
        f" {before.rpe_rotation_deg:.2f} deg -> {after.rpe_rotation_deg:.2f} deg"
        f" over {drift.rpe_interval_s:g} s"
    )


def _loops(summary: dict[str, object]) -> str:
    text = f"{summary['loops_accepted']} accepted of {summary['loops_tried']} candidates"
    if summary["loops_outvoted"]:
        text += f", {summary['loops_outvoted']} outvoted by the graph"
    if summary["loops_judged"]:
        text += f"; {summary['loops_false']} of {summary['loops_judged']} checked are false"
    return text

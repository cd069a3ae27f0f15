# SPDX-License-Identifier: Apache-2.0
"""The run in numbers: summary.json for programs, a few printed lines for people."""

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np

from slam.evaluation.drift import DriftReport, TrajectoryError
from slam.result import SlamResult
from slam.types import Camera, RejectionReason


def summarise(result: SlamResult, drift: DriftReport | None) -> dict[str, object]:
    """Return summary.json's content; every key says its unit, None stands for unknown.

    - camera: what the run took it to be; depth_scale in depth image units per metre.
    - sessions, segments: recordings, and those stretches without interruption that have a place.
    - frames_tracked, frames_untracked, keyframes, links: counts.
    - frames_unjoined: those of the untracked that are in a part of the map that was not joined.
    - loops_tried, loops_accepted, loops_outvoted: counts; accepted ones are those that both
      geometry and the pose graph believe, outvoted ones those that only geometry does.
    - loops_judged, loops_false: how many accepted loops ground truth covers, and how many of those
      are off by more than the limits.
    - min_similarity: the one from which candidates were verified.
    - certificate: what the recognizer was calibrated on, its curve apart; None without one.
    - ate_*_m, rpe_*_m, rpe_*_deg: root mean square errors before (odometry) and after (corrected).
    - alignment, scale: how the ATE was taken; the scale is never adjusted.
    - association_tolerance_s, matched_share, truth_coverage, truth_length_m: what stands behind
      it; matched_share is that of the tracked frames.
    - elapsed_s, frames_per_second, stage_seconds, stage_ms_per_frame: wall time, of the run and of
      its stages, some of which overlap.
    """
    return {
        "camera": {**asdict(result.camera), "distortion": list(result.camera.distortion)},
        **_counts(result),
        **_loop_counts(result, drift),
        **_recognizer(result),
        **_errors(drift),
        **_speed(result),
    }


def _counts(result: SlamResult) -> dict[str, object]:
    placed = zip(result.keyframes, np.isfinite(result.T_world_kf[:, 0, 0]), strict=True)
    return {
        "sessions": 1 + len(result.session_starts_s),
        "segments": len({each.segment for each, is_in in placed if is_in}),
        "frames_tracked": len(result.trajectory),
        "frames_untracked": len(result.untracked_s),
        "frames_unjoined": len(result.unjoined_s),
        "keyframes": len(result.keyframes),
        "links": len(result.links),
        "warnings": list(result.warnings),
    }


def _loop_counts(result: SlamResult, drift: DriftReport | None) -> dict[str, object]:
    verdicts = [loop.is_false for loop in drift.loops if loop.is_false is not None] if drift else []
    rejections = [attempt.rejection for attempt in result.attempts]
    reasons = [rejection.reason for rejection in rejections if rejection]
    return {
        "loops_tried": len(result.attempts),
        "loops_accepted": len(rejections) - len(reasons),
        "loops_outvoted": reasons.count(RejectionReason.OUTVOTED),
        "loops_judged": len(verdicts) if drift else None,
        "loops_false": sum(verdicts) if drift else None,
    }


def _recognizer(result: SlamResult) -> dict[str, object]:
    calibration = result.calibration
    return {
        "min_similarity": result.min_similarity,
        "certificate": calibration.certificate.model_dump(mode="json", exclude={"curve"})
        if calibration
        else None,
    }


def _errors(drift: DriftReport | None) -> dict[str, object]:
    before = drift.before if drift else None
    after = drift.after if drift else None
    return {
        "ate_before_m": _known(before.ate_rmse_m) if before else None,
        "ate_after_m": _known(after.ate_rmse_m) if after else None,
        **_relative_errors("before", before),
        **_relative_errors("after", after),
        "rpe_interval_s": drift.rpe_interval_s if drift else None,
        "alignment": "SE(3)" if drift else None,
        "scale": 1.0 if drift else None,
        "association_tolerance_s": drift.tolerance_s if drift else None,
        "matched_share": after.matched_share if after else None,
        "truth_coverage": drift.coverage if drift else None,
        "truth_length_m": drift.truth_length_m if drift else None,
    }


def _relative_errors(when: str, error: TrajectoryError | None) -> dict[str, object]:
    return {
        f"rpe_translation_{when}_m": _known(error.rpe_translation_m) if error else None,
        f"rpe_rotation_{when}_deg": _known(error.rpe_rotation_deg) if error else None,
    }


def _speed(result: SlamResult) -> dict[str, object]:
    frames = len(result.trajectory) + len(result.untracked_s)
    return {
        "elapsed_s": result.elapsed_s,
        "frames_per_second": frames / result.elapsed_s if result.elapsed_s > 0.0 else None,
        "stage_seconds": dict(result.stage_seconds),
        "stage_ms_per_frame": {
            stage: 1000.0 * seconds / frames for stage, seconds in result.stage_seconds.items()
        }
        if frames
        else {},
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def summary_table(result: SlamResult, drift: DriftReport | None, folder: Path) -> str:
    """Return the run in a few lines: what was tracked, which loops were closed, the drift."""
    summary = summarise(result, drift)
    tracked = len(result.trajectory)
    rows = [
        ("camera", _camera(result.camera)),
        ("frames", f"{tracked} of {tracked + len(result.untracked_s)} tracked"),
        ("keyframes", f"{len(result.keyframes)}"),
        ("recognizer", _calibrated(result)),
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


def _calibrated(result: SlamResult) -> str:
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

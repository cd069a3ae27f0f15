# SPDX-License-Identifier: Apache-2.0
"""The run in numbers: summary.json for programs, a few printed lines for people."""

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np

from slam.evaluation.drift import DriftReport
from slam.result import SlamResult
from slam.types import RejectionReason


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
    placed = zip(result.keyframes, np.isfinite(result.T_world_kf[:, 0, 0]), strict=True)
    rejections = [attempt.rejection for attempt in result.attempts]
    reasons = [rejection.reason for rejection in rejections if rejection]
    verdicts = [loop.is_false for loop in drift.loops if loop.is_false is not None] if drift else []
    calibration = result.calibration
    frames = len(result.trajectory) + len(result.untracked_s)
    return {
        "camera": {**asdict(result.camera), "distortion": list(result.camera.distortion)},
        "sessions": 1 + len(result.session_starts_s),
        "segments": len({keyframe.segment for keyframe, is_placed in placed if is_placed}),
        "frames_tracked": len(result.trajectory),
        "frames_untracked": len(result.untracked_s),
        "frames_unjoined": len(result.unjoined_s),
        "keyframes": len(result.keyframes),
        "links": len(result.links),
        "warnings": list(result.warnings),
        "loops_tried": len(result.attempts),
        "loops_accepted": len(rejections) - len(reasons),
        "loops_outvoted": reasons.count(RejectionReason.OUTVOTED),
        "loops_judged": len(verdicts) if drift else None,
        "loops_false": sum(verdicts) if drift else None,
        "min_similarity": result.min_similarity,
        "certificate": calibration.certificate.model_dump(mode="json", exclude={"curve"})
        if calibration
        else None,
        **_errors(drift),
        "elapsed_s": result.elapsed_s,
        "frames_per_second": frames / result.elapsed_s if result.elapsed_s > 0.0 else None,
        "stage_seconds": dict(result.stage_seconds),
        "stage_ms_per_frame": {
            stage: 1000.0 * seconds / frames for stage, seconds in result.stage_seconds.items()
        }
        if frames
        else {},
    }


def _errors(drift: DriftReport | None) -> dict[str, object]:
    def known(value: float) -> float | None:
        return value if math.isfinite(value) else None

    before, after = (drift.before, drift.after) if drift else (None, None)
    return {
        "ate_before_m": known(before.ate_rmse_m) if before else None,
        "ate_after_m": known(after.ate_rmse_m) if after else None,
        "rpe_translation_before_m": known(before.rpe_translation_m) if before else None,
        "rpe_rotation_before_deg": known(before.rpe_rotation_deg) if before else None,
        "rpe_translation_after_m": known(after.rpe_translation_m) if after else None,
        "rpe_rotation_after_deg": known(after.rpe_rotation_deg) if after else None,
        "rpe_interval_s": drift.rpe_interval_s if drift else None,
        "alignment": "SE(3)" if drift else None,
        "scale": 1.0 if drift else None,
        "association_tolerance_s": drift.tolerance_s if drift else None,
        "matched_share": after.matched_share if after else None,
        "truth_coverage": drift.coverage if drift else None,
        "truth_length_m": drift.truth_length_m if drift else None,
    }


def summary_table(result: SlamResult, drift: DriftReport | None, folder: Path) -> str:
    """Return the run in a few lines: what was tracked, which loops were closed, the drift."""
    summary = summarise(result, drift)
    camera, tracked = result.camera, len(result.trajectory)
    loops = f"{summary['loops_accepted']} accepted of {summary['loops_tried']} candidates"
    if summary["loops_outvoted"]:
        loops += f", {summary['loops_outvoted']} outvoted by the graph"
    if summary["loops_judged"]:
        loops += f"; {summary['loops_false']} of {summary['loops_judged']} checked are false"
    rows = [
        (
            "camera",
            f"{camera.width}x{camera.height}, fx {camera.fx:g}, fy {camera.fy:g} px,"
            f" {camera.depth_scale:g} depth units per metre",
        ),
        ("frames", f"{tracked} of {tracked + len(result.untracked_s)} tracked"),
        ("keyframes", f"{len(result.keyframes)}"),
        ("recognizer", f"verifies from similarity {result.min_similarity:.3f}, {_origin(result)}"),
        ("loops", loops),
        *(_drift_rows(drift) if drift else ()),
    ]
    if summary["frames_per_second"] is not None:
        rows.append(("pipeline", f"{summary['frames_per_second']:.1f} frames/s"))
    rows += [("warning", warning) for warning in result.warnings]
    rows.append(("report", str(folder / "report.html")))
    return "\n".join(f"{name:<10} {text}" for name, text in rows)


def _origin(result: SlamResult) -> str:
    if result.calibration is None:
        return "without a certificate"
    certificate = result.calibration.certificate
    low, high = certificate.threshold_interval
    return (
        f"calibrated on {certificate.data} ({certificate.pairs} pairs;"
        f" tau {certificate.threshold:.3f}, {low:.3f} to {high:.3f})"
    )


def _drift_rows(drift: DriftReport) -> list[tuple[str, str]]:
    before, after = drift.before, drift.after
    if math.isnan(before.rpe_translation_m) or math.isnan(after.rpe_translation_m):
        rpe = f"unknown: no two compared frames are {drift.rpe_interval_s:g} s apart"
    else:
        rpe = (
            f"{before.rpe_translation_m:.4f} m -> {after.rpe_translation_m:.4f} m,"
            f" {before.rpe_rotation_deg:.2f} deg -> {after.rpe_rotation_deg:.2f} deg"
            f" over {drift.rpe_interval_s:g} s"
        )
    covered = f"truth within {drift.tolerance_s * 1e3:.0f} ms, it covers {drift.coverage:.1%}"
    return [
        ("ATE", f"{before.ate_rmse_m:.4f} m -> {after.ate_rmse_m:.4f} m corrected"),
        ("", f"RMSE over {after.matched_share:.1%} of the tracked frames ({covered})"),
        ("", "after SE(3) alignment, scale not adjusted"),
        ("RPE", rpe),
    ]

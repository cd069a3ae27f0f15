# SPDX-License-Identifier: Apache-2.0
"""The run in numbers: summary.json for programs, a few printed lines for people."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from placerec.certificate import Certificate
from slam.evaluation.drift import DriftReport, TrajectoryError
from slam.evaluation.motion_truth import RIGHT_MEDIAN_NEES
from slam.output.counterfactual import counterfactual, looked_again, looked_again_in_words
from slam.result import MapMeshes, SlamResult
from slam.types import RejectionReason

_NO_TRUTH = (("error", "not known: no ground truth to compare with"),)
_TRAJECTORIES = ("odometry", "live", "without_loops", "corrected", "smoothed")


def summarise(result: SlamResult, drift: DriftReport | None) -> dict[str, object]:
    """Return summary.json's content; every key says its unit, None stands for unknown.

    - camera: what the run took it to be; depth_scale in depth image units per metre.
    - sessions, segments: recordings, and those stretches without interruption that have a place.
    - session_starts_s: when each session after the first starts, by the times of the images.
    - frames_tracked, frames_untracked, keyframes, links: counts.
    - frames_unjoined: those of the untracked that are in a part of the map that was not joined.
    - warnings: what to know before trusting the result, one sentence each.
    - given_poses, given_verdict: of an odometry from elsewhere, how many poses it had and what the
      images say of it; None without one.
    - loops_tried, loops_verified, loops_accepted, loops_outvoted: counts; of the verified ones
      geometry was asked, the others were left out before; accepted ones are those that both
      geometry and the pose graph believe, outvoted ones those that only geometry does.
    - keyframes_with_loop: those that have an accepted one to an earlier keyframe.
    - counterfactual: what adjusting did, what loops did and what each did; see `counterfactual`.
    - more_loops: what looking for loops again did; None where they were not; see `looked_again`.
    - loops_judged, loops_false: how many accepted loops ground truth covers, and how many of those
      are off by more than the limits, None where it says nothing of how the camera turned.
    - min_similarity: the one from which candidates were verified, in the end where it was adapted.
    - threshold: how reliable it is by the images met: what it is, or would be, adapted to them, the
      pairs of keyframes learnt from, and by estimate the share of the pairs of one place that it
      cuts off and of those of different places that pass; None where that is unknown.
    - certificate: what the recognizer was calibrated on and to, its curve apart; None without one.
    - frames_live: those of the tracked of which was known when they came where they are.
    - ate_*_m, rpe_translation_*_m, rpe_rotation_*_deg: root mean square errors of the frames, by
      tracking alone (odometry), corrected when they came (live), in the end with the map adjusted
      but no loop closed (without_loops), and with all (corrected). None of these are smoothed.
      Where smoothing was asked for, trajectory.txt is: `smoothed`.
    - rpe_interval_s: over which the relative pose error was taken.
    - nees_links_median, nees_loops_median: squared errors of the motions between keyframes, and of
      the accepted loops, in units of the standard deviations they claim. 5.35 is right; more means
      that errors are larger than claimed.
    - alignment, scale: how the ATE was taken; the scale is never adjusted.
    - association_tolerance_s, matched_share, truth_coverage, truth_length_m: what stands behind
      it; matched_share is that of the tracked frames.
    - mesh: how sharp the map is, `before` along the odometry, None where no loop was closed, and
      `after` along the corrected path: entropy, the mean map entropy in nats, and off_plane_m, the
      root of the mean plane variance; lower is sharper. None without meshes.
    - elapsed_s, frames_per_second, stage_seconds, stage_ms_per_frame: wall time, of the run and of
      its stages, some of which overlap; None, and no stages, where it is not known. compiling_s:
      for how long of that loops were compiled, which later runs find compiled.
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
        # As the poses' times are written, so that a session's first pose stays in it.
        "session_starts_s": [round(each, 6) for each in result.session_starts_s.tolist()],
        "segments": len({keyframe.segment for keyframe, is_placed in placed if is_placed}),
        "frames_tracked": len(result.trajectory),
        "frames_untracked": len(result.untracked_s),
        "frames_unjoined": len(result.unjoined_s),
        "frames_live": len(result.live),
        "keyframes": len(result.keyframes),
        "links": len(result.links),
        "warnings": list(result.warnings),
        "given_poses": len(result.given.given) if result.given else None,
        "given_verdict": result.given.verdict or None if result.given else None,
        "loops_tried": len(result.attempts),
        "loops_verified": sum(each.verification is not None for each in result.attempts),
        "loops_accepted": len(rejections) - len(reasons),
        "loops_outvoted": reasons.count(RejectionReason.OUTVOTED),
        "keyframes_with_loop": len(
            {attempt.query_id for attempt in result.attempts if attempt.rejection is None}
        ),
        "counterfactual": counterfactual(result, drift),
        "more_loops": looked_again(result, drift),
        "loops_judged": len(verdicts) if drift else None,
        "loops_false": sum(verdicts) if drift and not drift.unjudged else None,
        "min_similarity": result.min_similarity,
        "threshold": _threshold(result),
        "certificate": _told(calibration.certificate) if calibration else None,
        **_errors(drift),
        "mesh": _sharpness(result.meshes),
        "elapsed_s": result.elapsed_s,
        "compiling_s": result.compiling_s,
        "frames_per_second": frames / result.elapsed_s if result.elapsed_s else None,
        "stage_seconds": dict(result.stage_seconds),
        "stage_ms_per_frame": {
            stage: 1000.0 * seconds / frames for stage, seconds in result.stage_seconds.items()
        }
        if frames
        else {},
    }


def _threshold(result: SlamResult) -> dict[str, float | None] | None:
    fit = result.threshold
    if fit is None:
        return None
    return {
        "adapted": fit.adapted,
        "one_place_pairs": fit.one_place_pairs,
        "other_pairs": fit.other_pairs,
        "one_place_cut": _known(fit.cut),
        "different_places_passing": _known(fit.passing),
    }


def _sharpness(meshes: MapMeshes | None) -> dict[str, dict[str, float | None] | None] | None:
    if meshes is None:
        return None
    return {
        name: None
        if mesh is None
        else {"entropy": _known(mesh.entropy), "off_plane_m": _known(mesh.off_plane_m)}
        for name, mesh in (("before", meshes.before), ("after", meshes.after))
    }


def _known(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _errors(drift: DriftReport | None) -> dict[str, object]:
    errors = {name: getattr(drift, name) if drift else None for name in _TRAJECTORIES}
    return {
        **{f"ate_{name}_m": _known(each and each.ate_rmse_m) for name, each in errors.items()},
        **{
            f"rpe_translation_{name}_m": _known(each and each.rpe_translation_m)
            for name, each in errors.items()
        },
        **{
            f"rpe_rotation_{name}_deg": _known(each and each.rpe_rotation_deg)
            for name, each in errors.items()
        },
        "rpe_interval_s": drift.rpe_interval_s if drift else None,
        "alignment": "SE(3)" if drift else None,
        "scale": 1.0 if drift else None,
        "association_tolerance_s": drift.tolerance_s if drift else None,
        "matched_share": drift.corrected.matched_share if drift else None,
        "truth_coverage": drift.coverage if drift else None,
        "truth_length_m": drift.truth_length_m if drift else None,
        "nees_links_median": _known(drift.median_links_nees if drift else None),
        "nees_loops_median": _known(drift.median_loops_nees if drift else None),
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
        *([("", result.threshold.explanation)] if result.threshold else []),
        ("loops", loops),
        *(_drift_rows(drift) if drift else _NO_TRUTH),
    ]
    if more := looked_again_in_words(result, drift):
        rows.insert(rows.index(("loops", loops)) + 1, ("more loops", more))
    if result.meshes:
        rows.append(("mesh", result.meshes.explanation))
    if summary["frames_per_second"] is not None:
        speed = f"{summary['frames_per_second']:.1f} frames/s"
        if (result.compiling_s or 0.0) >= 0.05:
            speed += f", {result.compiling_s:.1f} s of compiling included"
        rows.append(("pipeline", speed))
    if result.given and result.given.verdict:
        rows.append(("given", result.given.verdict))
    rows += [("warning", warning) for warning in result.warnings]
    rows.append(("report", str(folder / "report.html")))
    return "\n".join(f"{name:<10} {text}" for name, text in rows)


def _told(certificate: Certificate) -> dict[str, Any]:
    thresholds = {"min_similarity": certificate.min_similarity, "threshold": certificate.threshold}
    return certificate.model_dump(mode="json", exclude={"curve"}) | thresholds


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
    first, last, live = drift.odometry, drift.corrected, drift.live
    if drift.unjudged:
        rpe = f"unknown: {drift.unjudged}"
    elif math.isnan(first.rpe_translation_m) or math.isnan(last.rpe_translation_m):
        rpe = f"unknown: no two compared frames are {drift.rpe_interval_s:g} s apart"
    else:
        rpe = (
            f"{first.rpe_translation_m:.4f} m -> {last.rpe_translation_m:.4f} m,"
            f" {first.rpe_rotation_deg:.2f} deg -> {last.rpe_rotation_deg:.2f} deg"
            f" over {drift.rpe_interval_s:g} s, odometry -> with loops"
        )
    smoothed = f"; smoothed {drift.smoothed.ate_rmse_m:.4f} m" if drift.smoothed else ""
    covered = f"truth within {drift.tolerance_s * 1e3:.0f} ms, it covers {drift.coverage:.1%}"
    return [
        ("ATE", f"odometry {first.ate_rmse_m:.4f} m; live, corrected {_live(live, first)}"),
        (
            "",
            f"in the end without loops {drift.without_loops.ate_rmse_m:.4f} m,"
            f" with loops {last.ate_rmse_m:.4f} m; not smoothed{smoothed}",
        ),
        ("", f"RMSE over {last.matched_share:.1%} of the tracked frames ({covered})"),
        ("", "after SE(3) alignment, scale not adjusted"),
        ("RPE", rpe),
        (
            "NEES",
            f"links {_nees(drift.median_links_nees)}, loops {_nees(drift.median_loops_nees)}"
            f" (medians; {RIGHT_MEDIAN_NEES} is right, more: errors are larger than claimed)",
        ),
    ]


def _live(live: TrajectoryError | None, odometry: TrajectoryError) -> str:
    if live is None:
        return "unknown: too few frames"
    fewer = len(live.timestamps_s) < len(odometry.timestamps_s)
    over = f" over {len(live.timestamps_s)} of {len(odometry.timestamps_s)} frames" if fewer else ""
    return f"{live.ate_rmse_m:.4f} m{over}"


def _nees(median: float) -> str:
    return "unknown" if math.isnan(median) else f"{median:.1f}"

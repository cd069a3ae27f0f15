# SPDX-License-Identifier: Apache-2.0
"""What the page's script draws: numbers of one run, small enough to lie in the page."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.drift import DriftReport
from slam.evaluation.per_metre import drift_per_metre
from slam.geometry import se3
from slam.output.counterfactual import left_out
from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision
from slam.output.ledger.writing import influence_record
from slam.output.report.paths import Paths, at_keyframes
from slam.output.report.pictures import map_points, packed, pictures
from slam.result import SlamResult, compared
from slam.types import FloatArray, IntArray

_MOST_FRAMES = 4000  # that are drawn; more cannot be told apart
_MOST_MATCHES = 120  # of a loop
_GROUPS = (ACCEPTED, FALSE, OUTVOTED, "rejected")
_SHADES = 254  # of a matrix; one more stands for unknown


@dataclass(frozen=True)
class Curve:
    """What is drawn along the path: a value per frame, NaN where unknown.

    Attributes:
        name: what it is of.
        colour: CSS variable.
        lengths_m: (N,) position error, or how far loops moved the frame.
        per_metre: (N,) metres of error per metre of path; empty where nobody knows.
    """

    name: str
    colour: str
    lengths_m: FloatArray
    per_metre: FloatArray


def curves(result: SlamResult, drift: DriftReport | None) -> list[Curve]:
    """Return the errors of odometry, and in the end without and with loops.

    Without ground truth, `drift` None, how far loop closure moved each frame.
    """
    nothing = np.zeros(0)
    if drift is None:
        return [Curve("moved by loops", "after", result.moved_by_loops_m, nothing)]
    found = []
    for name, colour, trajectory, error in (
        ("odometry", "before", result.odometry, drift.odometry),
        ("without loops", "without", result.without_loops, drift.without_loops),
        ("with loops", "after", result.corrected, drift.corrected),
    ):
        lengths_m = np.full(len(trajectory), np.nan)
        frames = np.searchsorted(trajectory.timestamps_s, error.timestamps_s)
        lengths_m[frames] = error.position_errors_m
        per_metre = nothing
        if not drift.unjudged:
            per_metre = drift_per_metre(
                trajectory, drift.truth, drift.tolerance_s, result.session_starts_s
            )
        found.append(Curve(name, colour, lengths_m, per_metre))
    return found


def page_data(
    result: SlamResult,
    drift: DriftReport | None,
    paths: Paths,
    loops: list[Decision],
    others: list[Decision],
) -> dict[str, Any]:
    """Return what the script reads, as JSON; `loops` are those listed, in their order.

    Of the others there is no more than what figures of all loops are drawn from.
    """
    chosen, shown = _drawn(paths)
    return {
        "frames": {
            "times_s": _floats(shown.times_s),
            "travelled_m": _floats(paths.travelled_m[chosen]),
            "stages": [_floats(stage[:, :3, 3]) for stage in shown.stages],
            "truth": _floats(shown.truth_m) if paths.in_truth_frame else None,
            "breaks": paths.breaks_among(chosen).tolist(),
            "curves": [
                {
                    "name": curve.name,
                    "colour": curve.colour,
                    "lengths": _floats(100.0 * curve.lengths_m[chosen]),
                    "per_metre": _floats(100.0 * curve.per_metre[chosen])
                    if len(curve.per_metre)
                    else None,
                }
                for curve in curves(result, drift)
            ],
        },
        "in_truth_frame": paths.in_truth_frame,
        "up": paths.up.tolist(),
        "enlargement": paths.enlargement,
        "lost_s": np.round(paths.lost_s, 3).tolist(),
        "lost_frames": _before(shown.times_s, paths.lost_s),
        "starts_s": np.round(paths.session_starts_s[1:], 3).tolist(),
        "keyframes": {
            "frames": shown.keyframe_frames.tolist(),
            "times_s": _floats(_keyframe_times(result, paths)),
            "stages": [
                _floats(at_keyframes(stage[:, :3], shown.keyframe_frames)) for stage in shown.stages
            ],
        },
        "map": map_points(result),
        "loops": [_loop(loop, result) for loop in loops],
        "others": {
            "pairs": _floats(np.array([(each.match.id, each.query.id) for each in others], float)),
            "groups": [_GROUPS.index(_group(each)) for each in others],
            "similarities": _floats(np.array([each.attempt.similarity for each in others], float)),
        },
        "pictures": pictures(result, loops),
        "aspect": result.camera.width / result.camera.height,
        "matrices": _matrices(result, paths),
        "min_similarity": result.min_similarity,
        "calibration": _calibration(result),
    }


def _drawn(paths: Paths) -> tuple[IntArray, Paths]:
    """Return which frames are drawn, every n-th and all keyframes, and the paths of these."""
    count = len(paths.times_s)
    of_keyframes = paths.keyframe_frames[paths.keyframe_frames >= 0]
    every = np.arange(0, count, -(-count // _MOST_FRAMES) or 1)
    chosen = np.union1d(every, of_keyframes).astype(np.int64)
    numbers = np.searchsorted(chosen, paths.keyframe_frames)
    return chosen, replace(
        paths,
        times_s=paths.times_s[chosen],
        odometry=paths.odometry[chosen],
        without_loops=paths.without_loops[chosen],
        corrected=paths.corrected[chosen],
        truth_m=paths.truth_m[chosen],
        keyframe_frames=np.where(paths.keyframe_frames >= 0, numbers, -1),
    )


def _before(times_s: FloatArray, lost_s: FloatArray) -> list[int]:
    """Return the last frames that were placed before others were lost."""
    last: list[int] = np.unique((np.searchsorted(times_s, lost_s) - 1).clip(0)).tolist()
    return last if len(times_s) else []


def _keyframe_times(result: SlamResult, paths: Paths) -> FloatArray:
    return paths.elapsed_s(np.array([keyframe.timestamp_s for keyframe in result.keyframes]))


def _loop(loop: Decision, result: SlamResult) -> dict[str, Any]:
    check = loop.attempt.verification
    pixels, agree = np.zeros((0, 4)), np.zeros(0, bool)
    if check is not None and len(check.pixels):
        cameras = (each.camera or result.camera for each in (loop.match, loop.query))
        size = np.array([side for each in cameras for side in (each.width, each.height)])
        agreeing, others = np.flatnonzero(check.inlier_mask), np.flatnonzero(~check.inlier_mask)
        kept = np.concatenate([_some(agreeing, _MOST_MATCHES), _some(others, _MOST_MATCHES // 2)])
        pixels, agree = check.pixels[kept] / size, check.inlier_mask[kept]
    similarity = float(loop.attempt.similarity)
    return {
        "motion": _motion(loop),
        "left_out": _left_out(loop),
        "pair": [int(loop.match.id), int(loop.query.id)],
        "group": _group(loop),
        "similarity": similarity if np.isfinite(similarity) else None,
        "matches": packed(np.rint(pixels.clip(0.0, 1.0) * 65535).astype("<u2").tobytes()),
        "agreeing": int(agree.sum()),
    }


def _left_out(loop: Decision) -> str:
    return left_out(record) if (record := influence_record(loop)) else ""


def _group(loop: Decision) -> str:
    return loop.kind if loop.kind in _GROUPS else _GROUPS[-1]


def _motion(loop: Decision) -> str:
    """Return the motion that was measured between the two views, for people."""
    if (motion := loop.attempt.motion) is None:
        return ""
    moved_cm = 100.0 * se3.translation_norm(motion.T_ref_query)
    turned_deg = np.rad2deg(se3.rotation_angle(motion.T_ref_query))
    return f"{moved_cm:.1f} cm and {turned_deg:.1f}° from the earlier to the later view"


def _some(values: IntArray, most: int) -> IntArray:
    return values[:: -(-len(values) // most) or 1]


def _matrices(result: SlamResult, paths: Paths) -> dict[str, Any]:
    """Return how alike and how far apart the compared keyframes are, in shades."""
    chosen = compared(len(result.keyframes))
    points_m = paths.keyframe_truth_m if paths.has_keyframe_truth else paths.keyframes_m
    points_m = points_m[:: chosen.step]
    distances_m = np.linalg.norm(points_m[:, None] - points_m[None], axis=2)
    return {
        "size": len(chosen),
        "step": chosen.step,
        "similarity": _shades(result.similarities),
        "distance": _shades(distances_m),
    }


def _shades(values: NDArray[np.floating[Any]]) -> dict[str, Any]:
    known = np.isfinite(values)
    low = float(values[known].min()) if known.any() else 0.0
    high = float(values[known].max()) if known.any() else 1.0
    shades = np.full(values.shape, _SHADES + 1, np.uint8)
    shades[known] = np.rint((values[known] - low) / max(high - low, 1e-9) * _SHADES)
    return {"low": low, "high": high, "shades": packed(shades.tobytes())}


def _calibration(result: SlamResult) -> dict[str, Any] | None:
    """Return how alike the keyframes look, counted, and where the calibration's pairs lay."""
    if result.calibration is None:
        return None
    certificate, live = result.calibration.certificate, result.calibration.live_similarities
    marks = (*certificate.calibrated_range, certificate.threshold, result.min_similarity)
    low, high = float(live.min(initial=min(marks))), float(live.max(initial=max(marks)))
    counts, edges = np.histogram(live, np.linspace(low - 1e-3, high + 1e-3, 61))
    return {
        "counts": counts.tolist(),
        "edges": np.round(edges, 6).tolist(),
        "different_places": list(certificate.different_places),
        "same_place": list(certificate.same_place),
        "threshold": certificate.threshold,
    }


def _floats(values: FloatArray) -> str:
    return packed(np.ascontiguousarray(values, "<f4").tobytes())

# SPDX-License-Identifier: Apache-2.0
"""Frames and loop candidates as a journal tells them, to the last bit, and back again."""

from typing import Any

import numpy as np

from slam.tracking.tracked_frame import TrackedFrame
from slam.types import (
    Check,
    Features,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    Verification,
)

Line = dict[str, Any]
_UPPER = np.triu_indices(6)


def _numbers(T: FloatArray) -> list[float]:
    numbers: list[float] = T[:3].ravel().tolist()
    return numbers


def _matrix(numbers: list[float]) -> FloatArray:
    return np.vstack([np.reshape(numbers, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def _of_motion(motion: RelativePose) -> list[list[float]]:
    return [_numbers(motion.T_ref_query), motion.information[_UPPER].tolist()]


def _to_motion(numbers: list[list[float]]) -> RelativePose:
    information = np.zeros((6, 6))
    information[_UPPER] = numbers[1]
    information.T[_UPPER] = numbers[1]
    return RelativePose(_matrix(numbers[0]), information)


def frame_line(tracked: TrackedFrame) -> Line:
    """Return what a journal tells of a frame, its time apart."""
    line: Line = {
        "against": tracked.keyframe_id,
        "segment": tracked.segment,
        "T_kf_cam": _numbers(tracked.T_kf_cam),
        "T_odom_cam": _numbers(tracked.T_odom_cam),
        "covered": tracked.covered,
    }
    if keyframe := tracked.new_keyframe:
        links = [[each.ref_id, each.query_id, *_of_motion(each.motion)] for each in tracked.links]
        line |= {
            "keyframe": [keyframe.timestamp_s, _numbers(keyframe.T_odom_cam)],
            "turning_rad_s": keyframe.turning_rad_s,
            "links": links,
            "moved": [[k, _numbers(T)] for k, T in tracked.moved.items()],
        }
    return line


def frame_of(line: Line, image: Frame) -> TrackedFrame:
    """Return the frame again; a keyframe has neither features nor its image, but that one."""
    keyframe_id, segment = int(line["against"]), int(line["segment"])
    T_kf_cam, T_odom_cam = _matrix(line["T_kf_cam"]), _matrix(line["T_odom_cam"])
    covered = float(line["covered"])
    if "keyframe" not in line:
        return TrackedFrame(keyframe_id, T_kf_cam, T_odom_cam, segment, covered=covered)
    timestamp_s, T = line["keyframe"]
    keyframe = Keyframe(
        keyframe_id,
        float(timestamp_s),
        _matrix(T),
        Features.none(),
        image,
        float(line["turning_rad_s"]),
        segment,
    )
    links = tuple(Link(ref, query, _to_motion(motion)) for ref, query, *motion in line["links"])
    moved = {k: _matrix(T) for k, T in line["moved"]}
    return TrackedFrame(keyframe_id, T_kf_cam, T_odom_cam, segment, keyframe, links, moved, covered)


def attempt_line(attempt: LoopAttempt) -> Line:
    """Return what a journal tells of a loop candidate."""
    line: Line = {
        "query": attempt.query_id,
        "match": attempt.match_id,
        "similarity": attempt.similarity,
    }
    if attempt.min_similarity is not None:
        line["min_similarity"] = attempt.min_similarity
    if rejection := attempt.rejection:
        line["rejection"] = [rejection.reason.name, rejection.measured, rejection.needed]
    if attempt.checks:
        line["checks"] = [[c.reason.name, c.measured, c.needed, c.passed] for c in attempt.checks]
    if attempt.motion:
        line["motion"] = _of_motion(attempt.motion)
    if seen := attempt.verification:
        line["is_inlier"] = "".join(str(int(each)) for each in seen.inlier_mask)
        if not rejection and len(seen.points_ref_m):
            points_m = seen.points_ref_m[seen.inlier_mask].astype(np.float64)
            line["points_m"] = np.round(points_m, 6).tolist()
    return {key: _plain(value) for key, value in line.items()}


def _plain(value: Any) -> Any:
    """Return numbers of numpy as Python's, which alone can be written."""
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def attempt_of(line: Line) -> LoopAttempt:
    """Return the candidate again, without the pixels of its matches."""
    motion = _to_motion(line["motion"]) if "motion" in line else None
    rejection = None
    if "rejection" in line:
        reason, measured, needed = line["rejection"]
        rejection = Rejection(RejectionReason[reason], measured, needed)
    outcome = rejection or motion
    if outcome is None:
        raise KeyError("rejection")
    checks = tuple(
        Check(RejectionReason[reason], *numbers) for reason, *numbers in line.get("checks", ())
    )
    verification = None
    if "is_inlier" in line:
        mask = np.array([each == "1" for each in line["is_inlier"]], bool)
        points_m = np.zeros((len(mask), 3), np.float32)
        if "points_m" in line:
            points_m[mask] = line["points_m"]
        pixels = np.zeros((len(mask), 4), np.float32)
        verification = Verification(motion or outcome, pixels, mask, points_m)
    return LoopAttempt(
        int(line["query"]),
        int(line["match"]),
        float(line["similarity"]),
        verification,
        outcome,
        min_similarity=float(line["min_similarity"]) if "min_similarity" in line else None,
        checks=checks,
    )

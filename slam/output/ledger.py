# SPDX-License-Identifier: Apache-2.0
"""The loop ledger, loops.jsonl: every loop decision with its numbers, one JSON object per line."""

import json
import math
from dataclasses import asdict, astuple
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from placerec.files import read_text, write_atomically
from slam.evaluation.drift import DriftReport
from slam.geometry import se3
from slam.output.decision import Decision, decisions
from slam.result import SlamResult
from slam.types import RelativePose, SlamError

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


@dataclass(frozen=True, config=_STRICT)
class MotionRecord:
    """T_match_query as measured, and how sure geometry was of it.

    Attributes:
        translation_m: x y z.
        quaternion_xyzw: of unit length, w >= 0.
        information: 21 numbers, the upper triangle of the (6, 6) matrix row by row, tangent
            [rotation; translation], rad^-2 and m^-2.
    """

    translation_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    information: tuple[float, ...]


@dataclass(frozen=True, config=_STRICT)
class TruthRecord:
    """What ground truth says of a loop; as `LoopTruth`, None where unknown."""

    translation_error_m: float | None
    rotation_error_deg: float | None
    true_distance_m: float | None
    true_angle_deg: float | None
    is_false: bool | None
    nees: float | None


@dataclass(frozen=True, config=_STRICT)
class LoopRecord:
    """One line of the ledger; its fields are the line's keys, in this order.

    Attributes:
        query_id, match_id: keyframe ids; the query is the later one.
        query_timestamp_s, match_timestamp_s: seconds.
        similarity, min_similarity: of the two embeddings, and from where one was verified then.
        accepted: whether geometry and the pose graph both believe the loop.
        reason: stable code of the rejection, such as `few_inliers`; None if accepted.
        explanation: the same in words.
        measured, needed: the number that decided and the one it needed; None if accepted.
        margin: needed - measured, the distance to the opposite decision.
        matches, inliers: counts of descriptor matches; None where geometry was not asked.
        T_match_query: the measured motion; None where geometry found none.
        weight: the pose graph's final trust, 0 (ignored) to 1; None where it was not asked.
        truth: None without ground truth at both keyframes.
    """

    query_id: int
    match_id: int
    query_timestamp_s: float
    match_timestamp_s: float
    similarity: float
    min_similarity: float
    accepted: bool
    reason: str | None
    explanation: str | None
    measured: float | None
    needed: float | None
    margin: float | None
    matches: int | None
    inliers: int | None
    T_match_query: MotionRecord | None
    weight: float | None
    truth: TruthRecord | None


_LINE = TypeAdapter(LoopRecord)


def write_ledger(path: Path, result: SlamResult, drift: DriftReport | None) -> None:
    """Write one line per loop attempt, in the order they were looked at.

    The same attempts always give the same bytes: fixed keys, nine significant digits.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    lines = [ledger_line(loop, result.min_similarity) for loop in decisions(result, drift)]
    write_atomically(path, "".join(f"{line}\n" for line in lines))


def ledger_line(loop: Decision, min_similarity: float) -> str:
    """Return a decision's line of the ledger, with the threshold where the decision knows none."""
    return json.dumps(asdict(_record(loop, min_similarity)), allow_nan=False)


def read_ledger(path: Path) -> tuple[LoopRecord, ...]:
    """Read back what `write_ledger` wrote.

    Raises:
        SlamError: the file cannot be read or a line is not a loop record; names the line.
    """
    records: list[LoopRecord] = []
    lines = read_text(path, what="the loop ledger", kind=SlamError).splitlines()
    try:
        for line in lines:
            records.append(_LINE.validate_json(line))
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "the line"
        raise SlamError(
            f"line {len(records) + 1} of the loop ledger: {name}: {first['msg']}: {path}"
        ) from error
    return tuple(records)


def loop_records(result: SlamResult, drift: DriftReport | None) -> tuple[LoopRecord, ...]:
    """Return the ledger's records of a run, one per loop attempt."""
    return tuple(_record(loop, result.min_similarity) for loop in decisions(result, drift))


def _record(loop: Decision, min_similarity: float) -> LoopRecord:
    attempt, rejection = loop.attempt, loop.attempt.rejection
    if attempt.min_similarity is not None:
        min_similarity = attempt.min_similarity
    truth = None
    if loop.truth is not None and not math.isnan(loop.truth.true_distance_m):
        *errors, is_false, nees = astuple(loop.truth)
        far_m, far_deg, apart_m, apart_deg = map(_number, errors)
        truth = TruthRecord(far_m, far_deg, apart_m, apart_deg, is_false, _number(nees))
    return LoopRecord(
        query_id=int(attempt.query_id),
        match_id=int(attempt.match_id),
        query_timestamp_s=round(float(loop.query.timestamp_s), 6),
        match_timestamp_s=round(float(loop.match.timestamp_s), 6),
        similarity=_digits(attempt.similarity),
        min_similarity=_digits(min_similarity),
        accepted=rejection is None,
        reason=rejection.reason.name.lower() if rejection else None,
        explanation=rejection.reason.value if rejection else None,
        measured=_number(rejection.measured) if rejection else None,
        needed=_number(rejection.needed) if rejection else None,
        margin=_number(rejection.needed - rejection.measured) if rejection else None,
        matches=loop.matches,
        inliers=loop.inliers,
        T_match_query=_motion_record(attempt.motion) if attempt.motion else None,
        weight=_number(attempt.weight) if attempt.weight is not None else None,
        truth=truth,
    )


def _motion_record(motion: RelativePose) -> MotionRecord:
    x, y, z = (_digits(value) for value in motion.T_ref_query[:3, 3])
    qx, qy, qz, qw = (_digits(value) for value in se3.to_quaternion(motion.T_ref_query[:3, :3]))
    upper = motion.information[np.triu_indices(6)]
    return MotionRecord((x, y, z), (qx, qy, qz, qw), tuple(_digits(value) for value in upper))


def _digits(value: float) -> float:
    # Nine significant digits hide the last bits, in which two computers may differ.
    return float(f"{value:.9g}") + 0.0


def _number(value: float) -> float | None:
    return _digits(value) if math.isfinite(value) else None

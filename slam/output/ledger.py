# SPDX-License-Identifier: Apache-2.0
"""The loop ledger, loops.jsonl: every loop decision with its numbers, one JSON object per line.

`docs/ledger.md` is its schema.
"""

import json
import math
from contextlib import suppress
from dataclasses import asdict, astuple
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from placerec.files import is_file, is_folder, read_text, write_atomically
from slam.evaluation.drift import DriftReport
from slam.geometry import se3
from slam.output.claimed_folder import UNFINISHED
from slam.output.decision import Decision, decisions
from slam.result import SlamResult
from slam.types import Check, Proposal, Rejection, RejectionReason, RelativePose, SlamError

VERSION: Literal[2] = 2
"""Of the schema: larger whenever a reader of the one before would be misled."""
_OLDEST = 1

_STAGES = {
    RejectionReason.LOW_SIMILARITY: "similarity",
    RejectionReason.SECOND_LOOK: "second_look",
    RejectionReason.FEW_MATCHES: "matches",
    RejectionReason.NO_POSE: "inliers",
    RejectionReason.FEW_INLIERS: "inliers",
    RejectionReason.LOW_INLIER_RATIO: "inlier_ratio",
    RejectionReason.NARROW_SUPPORT: "support",
    RejectionReason.UNCERTAIN_MOTION: "uncertainty",
    RejectionReason.UNJOINED: "joined",
    RejectionReason.OUTVOTED: "graph",
}
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
class InfluenceRecord:
    """What a loop in use did to the map, by the pose graph without it.

    Attributes:
        moved_rms_mm: root mean square of how far it moved the keyframes.
        moved_most_mm, moved_most_id: how far it moved the one that it moved most, and which.
        chi_square: by how much the graph's sum of squared errors would fall without it.
        verdict: helped or hurt, by ground truth; without that agrees, or contradicts where the fall
            exceeds the limit of the graph stage.
        helped_mm: how much larger the ATE of the keyframes would be; None without ground truth.
    """

    moved_rms_mm: float
    moved_most_mm: float
    moved_most_id: int
    chi_square: float
    verdict: str
    helped_mm: float | None


@dataclass(frozen=True, config=_STRICT)
class StageRecord:
    """What one stage measured of a candidate; numbers are None where they are not finite.

    Attributes:
        stage: similarity, second_look, matches, inliers, inlier_ratio, support, uncertainty, joined
            or graph.
        measured, needed: the number that the stage decides by, and what it has to be: at most that
            for uncertainty and graph, at least that for the others.
        margin: needed - measured, the distance to the opposite decision.
        passed: whether the stage said yes.
    """

    stage: str
    measured: float | None
    needed: float | None
    margin: float | None
    passed: bool


@dataclass(frozen=True, config=_STRICT)
class LoopRecord:
    """One line of the ledger; its fields are the line's keys, in this order.

    Attributes:
        version: of the schema.
        query_id, match_id: keyframe ids; the query is the later one.
        query_timestamp_s, match_timestamp_s: seconds.
        similarity, min_similarity: of the two embeddings, and from where one was verified then.
        accepted: whether geometry and the pose graph both believe the loop.
        reason: stable code of the rejection, such as `few_inliers`; None if accepted.
        explanation: the same in words.
        decided_by: the stage that rejected it; if accepted, the one that came nearest to that, as a
            share of what it needed.
        measured, needed, margin: of that stage; None where no stage is on record.
        stages: what every stage measured, in order, of those that the candidate came to.
        matches, inliers: counts of descriptor matches; None where geometry was not asked.
        T_match_query: the measured motion; None where geometry found none.
        weight: the pose graph's final trust, 0 (ignored) to 1; None where it was not asked.
        influence: what it did to the map; None of a loop not in use, or in a large map.
        truth: None without ground truth at both keyframes.
        proposed_by: what made it a candidate, a value of `Proposal`.
    """

    version: Literal[1, 2]
    query_id: int
    match_id: int
    query_timestamp_s: float
    match_timestamp_s: float
    similarity: float
    min_similarity: float
    accepted: bool
    reason: str | None
    explanation: str | None
    decided_by: str | None
    measured: float | None
    needed: float | None
    margin: float | None
    stages: tuple[StageRecord, ...]
    matches: int | None
    inliers: int | None
    T_match_query: MotionRecord | None
    weight: float | None
    influence: InfluenceRecord | None
    truth: TruthRecord | None
    proposed_by: str = Proposal.SIMILARITY.value  # all that version 1 knew


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


def renumbered(line: str, first: int) -> str:
    """Return a line of the ledger of keyframes whose numbers begin with another one than 0.

    Raises:
        SlamError: it is none.
    """
    try:
        record = json.loads(line)
        numbers = {name: record[name] + first for name in ("query_id", "match_id")}
        return json.dumps(record | numbers)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise SlamError("a line of a map's ledger is no loop record; make the map again") from error


def read_ledger(path: Path | str) -> tuple[LoopRecord, ...]:
    """Read back the loop decisions of a run, from its loops.jsonl or its folder.

    Of a run that was killed the folder has what was decided until then, before the pose graph had
    its say; a last line that was torn is left out.

    Raises:
        SlamError: the file cannot be read, a line is not a loop record, or it is of another version
            of the schema; names the line.
    """
    path = Path(path)
    if is_folder(path):
        left, name = path / UNFINISHED / "loops.jsonl", "loops.jsonl"
        path = left if is_file(left) and not is_file(path / name) else path / name
    lines = read_text(path, what="the loop ledger", kind=SlamError).split("\n")
    torn = lines.pop()  # nothing, after a whole line
    records = [_read(line, f"line {n} of the loop ledger", path) for n, line in enumerate(lines, 1)]
    with suppress(ValidationError):
        records += [_LINE.validate_json(torn)] if torn else []
    return tuple(records)


def _read(line: str, place: str, path: Path) -> LoopRecord:
    try:
        return _LINE.validate_json(line)
    except ValidationError as error:
        if (told := _of_another_version(line)) is not None:
            raise SlamError(f"{place} {told}: {path}") from error
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "the line"
        raise SlamError(f"{place}: {name}: {first['msg']}: {path}") from error


def _of_another_version(line: str) -> str | None:
    """Return what to say of a line of another version of the schema, None if it is none."""
    try:
        content = json.loads(line)
        version = content.get("version", 0 if "query_id" in content else VERSION)
        is_newer, is_older = version > VERSION, version < _OLDEST
    except (ValueError, TypeError, AttributeError, RecursionError):
        return None
    if is_newer:
        return f"is of schema {version}, and this reads {VERSION}: update loopclose"
    return f"was written before schema {_OLDEST}: run again" if is_older else None


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
    stages = tuple(_stage_record(each) for each in attempt.checks)
    decided = _deciding(stages, rejection)
    return LoopRecord(
        version=VERSION,
        query_id=int(attempt.query_id),
        match_id=int(attempt.match_id),
        query_timestamp_s=round(float(loop.query.timestamp_s), 6),
        match_timestamp_s=round(float(loop.match.timestamp_s), 6),
        similarity=_digits(attempt.similarity),
        min_similarity=_digits(min_similarity),
        accepted=rejection is None,
        reason=rejection.reason.name.lower() if rejection else None,
        explanation=rejection.reason.value if rejection else None,
        decided_by=decided.stage if decided else None,
        measured=decided.measured if decided else None,
        needed=decided.needed if decided else None,
        margin=decided.margin if decided else None,
        stages=stages,
        matches=loop.matches,
        inliers=loop.inliers,
        T_match_query=_motion_record(attempt.motion) if attempt.motion else None,
        weight=_number(attempt.weight) if attempt.weight is not None else None,
        influence=influence_record(loop),
        truth=truth,
        proposed_by=attempt.proposed_by.value,
    )


def influence_record(loop: Decision) -> InfluenceRecord | None:
    """Return what a loop did to the map, None where that is not known."""
    influence = loop.attempt.influence
    if influence is None or not math.isfinite(influence.chi_square):
        return None
    limits = [c.needed for c in loop.attempt.checks if c.reason is RejectionReason.OUTVOTED]
    is_known = math.isfinite(loop.helped_m)
    is_good = (
        loop.helped_m >= 0.0 if is_known else influence.chi_square <= min(limits, default=math.inf)
    )
    names = ("helped", "hurt") if is_known else ("agrees", "contradicts")
    most_id, most_m = influence.most
    return InfluenceRecord(
        moved_rms_mm=_digits(1000.0 * influence.rms_m),
        moved_most_mm=_digits(1000.0 * most_m),
        moved_most_id=most_id,
        chi_square=_digits(influence.chi_square),
        verdict=names[0] if is_good else names[1],
        helped_mm=_number(1000.0 * loop.helped_m),
    )


def _stage_record(check: Check | Rejection) -> StageRecord:
    return StageRecord(
        _STAGES.get(check.reason, check.reason.name.lower()),
        _number(check.measured),
        _number(check.needed),
        _number(check.needed - check.measured),
        passed=isinstance(check, Check) and check.passed,
    )


def _deciding(stages: tuple[StageRecord, ...], rejection: Rejection | None) -> StageRecord | None:
    """Return the stage that said no, or else the one that came nearest to that."""
    if rejection:
        refused = _stage_record(rejection)
        return next((each for each in stages if each.stage == refused.stage), refused)
    known = [each for each in stages if each.margin is not None and each.needed]
    return min(
        known, key=lambda each: abs(each.margin or 0.0) / abs(each.needed or 1.0), default=None
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

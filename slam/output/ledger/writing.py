# SPDX-License-Identifier: Apache-2.0
"""Writes the decisions of a run as a ledger."""

import json
import math
from dataclasses import asdict, astuple
from pathlib import Path

import numpy as np

from placerec.files import write_atomically
from slam.evaluation.drift import DriftReport
from slam.geometry import se3
from slam.output.decision import Decision, decisions
from slam.output.ledger.records import (
    VERSION,
    InfluenceRecord,
    LoopRecord,
    MotionRecord,
    StageRecord,
    TruthRecord,
)
from slam.result import SlamResult
from slam.types import Check, Rejection, RejectionReason, RelativePose, SlamError

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


def write_ledger(path: Path, result: SlamResult, drift: DriftReport | None) -> None:
    """Write one line per loop attempt, in the order they were looked at.

    The same attempts always give the same bytes: fixed keys, nine significant digits.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    lines = [_line(record) for record in loop_records(result, drift)]
    write_atomically(path, "".join(f"{line}\n" for line in lines))


def ledger_line(loop: Decision, min_similarity: float) -> str:
    """Return a decision's line of the ledger, with the threshold where the decision knows none."""
    return _line(_record(loop, min_similarity))


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


def loop_records(result: SlamResult, drift: DriftReport | None) -> tuple[LoopRecord, ...]:
    """Return the ledger's records of a run, one per loop attempt."""
    return tuple(_record(loop, result.min_similarity) for loop in decisions(result, drift))


def _line(record: LoopRecord) -> str:
    return json.dumps(asdict(record), allow_nan=False)


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

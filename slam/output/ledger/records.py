# SPDX-License-Identifier: Apache-2.0
"""What a line of the ledger holds; `docs/ledger.md` is its schema."""

from typing import Literal

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from slam.types import Proposal

VERSION: Literal[2] = 2
"""Of the schema: larger whenever a reader of the one before would be misled."""

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

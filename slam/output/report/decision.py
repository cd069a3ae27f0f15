# SPDX-License-Identifier: Apache-2.0
"""One loop decision as people read it: what was decided, by which number, and was it right."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from slam.evaluation.drift import DriftReport, LoopTruth
from slam.result import SlamResult
from slam.types import Keyframe, LoopAttempt, Rejection, RejectionReason

FALSE, ACCEPTED = "false", "accepted"
OUTVOTED = RejectionReason.OUTVOTED.name.lower()


def _count(what: str) -> Callable[[float, float], str]:
    def describe(measured: float, needed: float) -> str:
        return f"needed {needed:.0f} {what}, had {measured:.0f}: {needed - measured:.0f} short"

    return describe


def _share(what: str) -> Callable[[float, float], str]:
    def describe(measured: float, needed: float) -> str:
        short = 100 * (needed - measured)
        return f"needed {needed:.1%} {what}, had {measured:.1%}: {short:.1f} points short"

    return describe


def _similarity(measured: float, needed: float) -> str:
    if not math.isfinite(measured):
        return f"needed similarity {needed:.3f}, had none"
    return f"needed similarity {needed:.3f}, had {measured:.3f}: {needed - measured:.3f} short"


def _weight(measured: float, needed: float) -> str:
    return f"needed weight {needed:.2f} in the pose graph, had {measured:.2f}"


def _uncertainty(measured: float, needed: float) -> str:
    return f"needed a motion known to {100 * needed:.1f} cm, had {100 * measured:.1f} cm"


_MARGINS: dict[RejectionReason, Callable[[float, float], str]] = {
    RejectionReason.LOW_SIMILARITY: _similarity,
    RejectionReason.FEW_MATCHES: _count("matches with depth"),
    RejectionReason.NO_POSE: _count("matches on one rigid motion"),
    RejectionReason.FEW_INLIERS: _count("inliers"),
    RejectionReason.LOW_INLIER_RATIO: _share("of the matches as inliers"),
    RejectionReason.NARROW_SUPPORT: _share("of the image covered by inliers"),
    RejectionReason.UNCERTAIN_MOTION: _uncertainty,
    RejectionReason.OUTVOTED: _weight,
    RejectionReason.UNJOINED: _count("loops that agree where its part of the map lies"),
}


@dataclass(frozen=True)
class Decision:
    """A loop attempt with its two keyframes and what ground truth says of it.

    Attributes:
        attempt: the candidate and its outcome.
        query, match: the later and the earlier keyframe.
        truth: ground truth's word, or None without ground truth.
    """

    attempt: LoopAttempt
    query: Keyframe
    match: Keyframe
    truth: LoopTruth | None

    @property
    def rejection(self) -> Rejection | None:
        """Why the loop is not in use, by geometry or by the pose graph; None for accepted ones."""
        return self.attempt.rejection

    @property
    def kind(self) -> str:
        """What became of it: accepted, false, or the name of the rejection's reason."""
        if rejection := self.rejection:
            return rejection.reason.name.lower()
        return FALSE if self.truth is not None and self.truth.is_false else ACCEPTED

    @property
    def label(self) -> str:
        """The kind in plain words."""
        if rejection := self.rejection:
            return rejection.reason.value
        return "accepted, but false by ground truth" if self.kind == FALSE else "accepted"

    @property
    def matches(self) -> int | None:
        """Number of descriptor matches, None where geometry was not asked."""
        check = self.attempt.verification
        return None if check is None else len(check.pixels)

    @property
    def inliers(self) -> int | None:
        """Number of matches on one rigid motion, None where geometry was not asked."""
        check = self.attempt.verification
        return None if check is None else int(check.inlier_mask.sum())

    @property
    def shortfall(self) -> float:
        """How far a rejected candidate was from the opposite decision, as a share of the need."""
        if not (rejection := self.rejection):
            return 0.0
        gap = abs(rejection.needed - rejection.measured) / max(abs(rejection.needed), 1e-9)
        return gap if math.isfinite(gap) else math.inf

    @property
    def margin(self) -> str:
        """Measured against needed, or how much an accepted loop is trusted."""
        if rejection := self.rejection:
            return _MARGINS[rejection.reason](rejection.measured, rejection.needed)
        if self.attempt.weight is None:
            return "not weighed by the pose graph"
        return f"weight {self.attempt.weight:.2f} in the pose graph"

    @property
    def truth_text(self) -> str:
        """What ground truth says: error of a measured motion, else how far the cameras were."""
        truth = self.truth
        if truth is None or not math.isfinite(truth.true_distance_m):
            return ""
        if math.isfinite(truth.translation_error_m):
            return (
                f"off by {100 * truth.translation_error_m:.1f} cm, "
                f"{truth.rotation_error_deg:.1f}° against ground truth"
            )
        return f"in truth {truth.true_distance_m:.2f} m and {truth.true_angle_deg:.0f}° apart"


def decisions(result: SlamResult, drift: DriftReport | None) -> list[Decision]:
    """Return every loop attempt of a run, in the order it was looked at."""
    keyframes = {keyframe.id: keyframe for keyframe in result.keyframes}
    truths = drift.loops if drift is not None else (None,) * len(result.attempts)
    return [
        Decision(attempt, keyframes[attempt.query_id], keyframes[attempt.match_id], truth)
        for attempt, truth in zip(result.attempts, truths, strict=True)
    ]

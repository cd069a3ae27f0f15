# SPDX-License-Identifier: Apache-2.0
"""One loop decision as people read it: what was decided, by which number, and was it right."""

import math
from dataclasses import dataclass

from slam.evaluation.drift import DriftReport
from slam.evaluation.motion_truth import LoopTruth
from slam.result import SlamResult
from slam.types import Keyframe, LoopAttempt, Proposal, RejectionReason

FALSE, ACCEPTED = "false", "accepted"
OUTVOTED = RejectionReason.OUTVOTED.name.lower()

LOOKED_AGAIN = {
    Proposal.OVERLAP: "whose views should overlap by the map",
    Proposal.NEXT_SIMILAR: "that are next in similarity",
}
"""What proposes pairs of keyframes where loops are looked for again."""

_COUNT = "needed {needed:.0f} %s, had {measured:.0f}: {short:.0f} short"
_SHARE = "needed {needed:.1%%} %s, had {measured:.1%%}: {short_percent:.1f} points short"
_MARGINS = {
    RejectionReason.LOW_SIMILARITY: (
        "needed similarity {needed:.3f}, had {measured:.3f}: {short:.3f} short"
    ),
    RejectionReason.SECOND_LOOK: "needed {needed:.3g} at a second look, had {measured:.3g}",
    RejectionReason.SMEARED: "needed a sharpness of {needed:.2f}, had {measured:.2f}",
    RejectionReason.FEW_MATCHES: _COUNT % "matches with depth",
    RejectionReason.NO_POSE: _COUNT % "matches on one rigid motion",
    RejectionReason.FEW_INLIERS: _COUNT % "inliers",
    RejectionReason.LOW_INLIER_RATIO: _SHARE % "of the matches as inliers",
    RejectionReason.NARROW_SUPPORT: _SHARE % "of the image covered by inliers",
    RejectionReason.UNCERTAIN_MOTION: (
        "needed a motion known to {needed:.1%} of the depth of what is seen, had {measured:.1%}"
    ),
    RejectionReason.OUTVOTED: "needed weight {needed:.2f} in the pose graph, had {measured:.2f}",
    RejectionReason.UNJOINED: _COUNT % "places at which loops agree where its part of the map lies",
}


@dataclass(frozen=True)
class Decision:
    """A loop attempt with its two keyframes and what ground truth says of it.

    Attributes:
        attempt: the candidate and its outcome.
        query, match: the later and the earlier keyframe.
        truth: ground truth's word, or None without ground truth.
        helped_m: how much larger the ATE would be without it, NaN where nobody knows.
    """

    attempt: LoopAttempt
    query: Keyframe
    match: Keyframe
    truth: LoopTruth | None
    helped_m: float = math.nan

    @property
    def kind(self) -> str:
        """What became of it: accepted, false, or the name of the rejection's reason."""
        if rejection := self.attempt.rejection:
            return rejection.reason.name.lower()
        return FALSE if self.truth is not None and self.truth.is_false else ACCEPTED

    @property
    def label(self) -> str:
        """The kind in plain words."""
        if rejection := self.attempt.rejection:
            return rejection.reason.value
        return "accepted, but false by ground truth" if self.kind == FALSE else "accepted"

    @property
    def matches(self) -> int | None:
        """Number of descriptor matches, None where geometry was not asked."""
        check = self.attempt.verification
        return None if check is None else len(check.inlier_mask)

    @property
    def inliers(self) -> int | None:
        """Number of matches on one rigid motion, None where geometry was not asked."""
        check = self.attempt.verification
        return None if check is None else int(check.inlier_mask.sum())

    @property
    def shortfall(self) -> float:
        """How far a rejected candidate was from the opposite decision, as a share of the need."""
        if not (rejection := self.attempt.rejection):
            return 0.0
        gap = abs(rejection.needed - rejection.measured) / max(abs(rejection.needed), 1e-9)
        return gap if math.isfinite(gap) else math.inf

    @property
    def margin(self) -> str:
        """Measured against needed, or how much an accepted loop is trusted."""
        if not (rejection := self.attempt.rejection):
            weight = self.attempt.weight
            if weight is None:
                return "not weighed by the pose graph"
            return f"weight {weight:.2f} in the pose graph"
        needed, measured = rejection.needed, rejection.measured
        if rejection.reason is RejectionReason.LOW_SIMILARITY and not math.isfinite(measured):
            return f"needed similarity {needed:.3f}, had none"
        return _MARGINS[rejection.reason].format(
            needed=needed,
            measured=measured,
            short=needed - measured,
            short_percent=100 * (needed - measured),
        )

    @property
    def proposal(self) -> str:
        """What made it a candidate where loops were looked for again, else nothing."""
        return LOOKED_AGAIN.get(self.attempt.proposed_by, "")

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
    helped_m = drift.helped_m.tolist() if drift is not None else []
    helped_m = helped_m or [math.nan] * len(truths)
    return [
        Decision(attempt, keyframes[attempt.query_id], keyframes[attempt.match_id], truth, helped)
        for attempt, truth, helped in zip(result.attempts, truths, helped_m, strict=True)
    ]

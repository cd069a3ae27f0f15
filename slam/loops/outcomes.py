# SPDX-License-Identifier: Apache-2.0
"""What became of loops once the graph had weighed them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from slam.loops.submaps import NEEDED_PLACES
from slam.types import MIN_TRUSTED_WEIGHT, LoopAttempt, Rejection, RejectionReason


def refusals(attempts: Sequence[LoopAttempt]) -> tuple[str, ...]:
    """Return a sentence if one reason refused more than half of the verified loops."""
    verified = [each for each in attempts if each.motion is not None]
    reasons = Counter(each.rejection.reason for each in verified if each.rejection)
    for reason, count in reasons.most_common(1):
        if 2 * count > len(verified):
            return (
                f"{count} of {len(verified)} loops that geometry verified are not in use, all for"
                f" one reason: {reason}",
            )
    return ()


def in_the_end(attempt: LoopAttempt, weight: float | None, places: int | None) -> LoopAttempt:
    """Return what the graph makes of a loop: in use, outvoted or not joined to the largest submap.

    The weight is None where the graph was not given the loop; loops at so many places say where its
    submap lies, None where that is the largest.
    """
    if places is not None:
        return replace(attempt, outcome=Rejection(RejectionReason.UNJOINED, places, NEEDED_PLACES))
    if weight is None or weight > MIN_TRUSTED_WEIGHT:
        return replace(attempt, weight=weight)
    outvoted = Rejection(RejectionReason.OUTVOTED, weight, MIN_TRUSTED_WEIGHT)
    # The motion stays on record with the noise that the graph was told.
    seen = attempt.verification and replace(attempt.verification, outcome=attempt.outcome)
    return replace(attempt, verification=seen, outcome=outvoted, weight=weight)

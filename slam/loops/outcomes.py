# SPDX-License-Identifier: Apache-2.0
"""What became of loops once the graph had weighed them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from slam.loops.submaps import NEEDED_PLACES
from slam.pose_graph import GraphSolution
from slam.types import MIN_TRUSTED_WEIGHT, Check, LoopAttempt, Rejection, RejectionReason


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


def in_the_end(
    attempt: LoopAttempt, key: int, solution: GraphSolution, unjoined: Mapping[int, int]
) -> LoopAttempt:
    """Return what the graph makes of a loop: in use, outvoted or not joined to the largest submap.

    The graph was given it by that key, or not at all; unjoined tells, per key, at how many places
    loops say where its submap lies, where that is not the largest.
    """
    if (places := unjoined.get(key)) is not None:
        apart = Check(RejectionReason.UNJOINED, places, NEEDED_PLACES, passed=False)
        return replace(
            attempt,
            outcome=Rejection(apart.reason, places, NEEDED_PLACES),
            checks=(*attempt.checks, apart),
        )
    if (weight := solution.weights.get(key)) is None:
        return attempt
    is_trusted = weight > MIN_TRUSTED_WEIGHT
    if key in solution.squared_errors:
        squared, limit = solution.squared_errors[key], solution.limit
        agrees = Check(RejectionReason.OUTVOTED, squared, limit, is_trusted)
        attempt = replace(attempt, checks=(*attempt.checks, agrees))
    if is_trusted:
        return replace(attempt, weight=weight)
    outvoted = Rejection(RejectionReason.OUTVOTED, weight, MIN_TRUSTED_WEIGHT)
    # The motion stays on record with the noise that the graph was told.
    seen = attempt.verification and replace(attempt.verification, outcome=attempt.outcome)
    return replace(attempt, verification=seen, outcome=outvoted, weight=weight)

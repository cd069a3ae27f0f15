# SPDX-License-Identifier: Apache-2.0
"""The final word on a loop attempt, after geometry and the pose graph have both been heard."""

from slam.types import (
    MIN_TRUSTED_WEIGHT,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
)


def final_rejection(attempt: LoopAttempt) -> Rejection | None:
    """Return why a loop is not in use, or None if geometry and the pose graph both believe it."""
    if isinstance(attempt.outcome, Rejection):
        return attempt.outcome
    if attempt.weight is not None and attempt.weight <= MIN_TRUSTED_WEIGHT:
        return Rejection(RejectionReason.OUTVOTED, attempt.weight, MIN_TRUSTED_WEIGHT)
    return None


def measured_motion(attempt: LoopAttempt) -> RelativePose | None:
    """Return the motion that geometry measured, also of a loop that the graph outvoted."""
    if isinstance(attempt.outcome, RelativePose):
        return attempt.outcome
    found = attempt.verification.outcome if attempt.verification else None
    return found if isinstance(found, RelativePose) else None

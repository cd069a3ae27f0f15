# SPDX-License-Identifier: Apache-2.0
"""In which order loop decisions are worth a look: the doubtful ones first."""

from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision

_TRUSTED = 0.9
"""Weight in the pose graph from which an accepted loop is beyond doubt."""
_NEAR = 0.25
"""A rejection that lacked no more than this share of what it needed was a near miss."""


def by_doubt(loops: list[Decision]) -> list[Decision]:
    """Return false loops, outvoted ones, accepted ones hardly trusted, near misses, then the rest.

    Accepted loops follow each other from the one with the fewest inliers, rejections from the
    nearest miss.
    """
    return sorted(loops, key=_rank)


def is_doubtful(loop: Decision) -> bool:
    """Return whether a decision might as well have been another."""
    return _rank(loop)[0] < 4


def _rank(loop: Decision) -> tuple[int, float, int]:
    if loop.kind == FALSE:
        return 0, -(loop.truth.translation_error_m if loop.truth else 0.0), loop.query.id
    if loop.kind == OUTVOTED:
        return 1, loop.shortfall, loop.query.id
    if loop.kind == ACCEPTED:
        is_trusted = (loop.attempt.weight or 0.0) >= _TRUSTED
        return (4 if is_trusted else 2), loop.inliers or 0, loop.query.id
    return (3 if loop.shortfall <= _NEAR else 5), loop.shortfall, loop.query.id

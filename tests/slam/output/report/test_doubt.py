# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest

from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision, decisions
from slam.output.report.doubt import by_doubt, is_doubtful
from slam.types import Rejection, RejectionReason


def one_of(loops: list[Decision], kind: str) -> Decision:
    return next(loop for loop in loops if loop.kind == kind)


def weighed(loop: Decision, weight: float | None) -> Decision:
    return replace(loop, attempt=replace(loop.attempt, weight=weight))


def missed(loop: Decision, had: float) -> Decision:
    refusal = Rejection(RejectionReason.FEW_INLIERS, had, 25)
    return replace(loop, attempt=replace(loop.attempt, outcome=refusal))


def test_doubtful_ones_come_first(run) -> None:
    loops = decisions(run.result, run.drift)
    right = one_of(loops, ACCEPTED)
    false = replace(right, truth=replace(right.truth, is_false=True))
    outvoted = one_of(loops, OUTVOTED)
    hardly, unweighed = weighed(right, 0.6), weighed(right, None)
    near, far = missed(outvoted, 24), missed(outvoted, 3)
    order = [false, outvoted, hardly, unweighed, near, right, far]
    assert by_doubt(order[::-1])[:2] == [false, outvoted]
    assert [is_doubtful(loop) for loop in order] == 5 * [True] + 2 * [False]
    assert by_doubt([far, right, near, hardly, outvoted, false]) == [
        *(false, outvoted, hardly, near, right, far)
    ]


def test_nothing_is_lost_and_the_fewest_inliers_come_first(run) -> None:
    loops = decisions(run.result, run.drift)
    ordered = by_doubt(loops)
    assert sorted(map(id, ordered)) == sorted(map(id, loops))
    inliers = [loop.inliers for loop in ordered if loop.kind == ACCEPTED]
    assert inliers == sorted(inliers)


@pytest.mark.parametrize("far_m", [0.3, 2.0])
def test_the_worst_of_the_false_comes_first(run, far_m: float) -> None:
    loop = one_of(decisions(run.result, run.drift), ACCEPTED)
    one, other = (
        replace(loop, truth=replace(loop.truth, is_false=True, translation_error_m=error_m))
        for error_m in (1.0, far_m)
    )
    assert one.kind == FALSE
    assert by_doubt([one, other])[0] is (other if far_m > 1.0 else one)

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.evaluation.motion_truth import LoopTruth
from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision, decisions
from slam.types import LoopAttempt, Rejection, RejectionReason, RelativePose


def decide(run, outcome: object, weight: float | None = None, truth: object = None) -> Decision:
    attempt = LoopAttempt(30, 2, 0.9, None, outcome, weight)
    return Decision(attempt, run.result.keyframes[30], run.result.keyframes[2], truth)


MOTION = RelativePose(np.eye(4), np.eye(6))
RIGHT = LoopTruth(0.02, 0.5, 0.1, 3.0, False)
WRONG = LoopTruth(0.40, 0.5, 0.1, 3.0, True)


@pytest.mark.parametrize(
    ("reason", "measured", "needed", "text"),
    [
        (RejectionReason.FEW_INLIERS, 19, 25, "needed 25 inliers, had 19: 6 short"),
        (RejectionReason.LOW_SIMILARITY, 0.71, 0.75, "needed similarity 0.750, had 0.710: 0.040"),
        (RejectionReason.LOW_INLIER_RATIO, 0.18, 0.25, "needed 25.0% of the matches"),
        (RejectionReason.NARROW_SUPPORT, 0.012, 0.04, "2.8 points short"),
        (RejectionReason.OUTVOTED, 0.02, 0.5, "needed weight 0.50 in the pose graph, had 0.02"),
        (
            RejectionReason.UNCERTAIN_MOTION,
            0.123,
            0.1,
            "10.0% of the depth of what is seen, had 12.3%",
        ),
        (RejectionReason.LOW_SIMILARITY, np.nan, 0.75, "needed similarity 0.750, had none"),
        (RejectionReason.UNJOINED, 1, 2, "needed 2 places at which loops agree where its part"),
    ],
)
def test_a_rejection_says_how_much_was_missing(run, reason, measured, needed, text) -> None:
    assert text in decide(run, Rejection(reason, measured, needed)).margin


@pytest.mark.parametrize("reason", list(RejectionReason))
@pytest.mark.parametrize("measured", [0.0, 3.0, np.nan, np.inf])
def test_every_reason_has_words(run, reason: RejectionReason, measured: float) -> None:
    loop = decide(run, Rejection(reason, measured, 25.0))
    assert loop.kind == reason.name.lower()
    assert loop.label == reason.value
    assert loop.margin
    assert loop.shortfall >= 0.0


@pytest.mark.parametrize(
    ("weight", "truth", "kind"),
    [
        (0.99, None, ACCEPTED),
        (None, RIGHT, ACCEPTED),
        (0.99, WRONG, FALSE),
    ],
)
def test_truth_decides_the_kind_of_an_accepted_loop(run, weight, truth, kind) -> None:
    assert decide(run, MOTION, weight, truth).kind == kind


@pytest.mark.parametrize("truth", [None, replace(WRONG, is_false=None)])
def test_an_outvoted_loop_is_not_called_false(run, truth) -> None:
    outvoted = Rejection(RejectionReason.OUTVOTED, 0.01, 0.5)
    assert decide(run, outvoted, 0.01, truth).kind == OUTVOTED


def test_truth_is_worded_for_measured_and_for_rejected_loops(run) -> None:
    assert decide(run, MOTION, 1.0, WRONG).truth_text == "off by 40.0 cm, 0.5° against ground truth"
    apart = LoopTruth(np.nan, np.nan, 0.8, 25.0, None)
    rejected = decide(run, Rejection(RejectionReason.FEW_MATCHES, 3, 20), None, apart)
    assert rejected.truth_text == "in truth 0.80 m and 25° apart"
    unknown = replace(apart, true_distance_m=np.nan)
    assert decide(run, MOTION, 1.0, unknown).truth_text == ""


def test_decisions_keep_the_order_and_pair_keyframes(run) -> None:
    found = decisions(run.result, run.drift)
    assert [loop.attempt for loop in found] == list(run.result.attempts)
    assert all(loop.query.id == loop.attempt.query_id for loop in found)
    assert all(loop.query.timestamp_s > loop.match.timestamp_s for loop in found)

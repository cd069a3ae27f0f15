# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace

import numpy as np
import pytest

from slam.output.counterfactual import by_influence, counterfactual, in_words, left_out
from slam.output.decision import decisions
from slam.types import Check, Influence, RejectionReason


def moving(run, shifts_mm, chi_squares, helped_mm=None):
    """Return a made-up run in which the first loops in use moved all keyframes by so much."""
    ids, left = np.arange(len(run.result.keyframes)), list(zip(shifts_mm, chi_squares, strict=True))
    attempts, helped_m = [], []
    graph = (Check(RejectionReason.OUTVOTED, 1.0, 12.6, passed=True),)
    for attempt in run.result.attempts:
        told = np.nan
        if attempt.rejection is None and left:
            told = helped_mm[len(shifts_mm) - len(left)] / 1000.0 if helped_mm else np.nan
            shift_mm, chi_square = left.pop(0)
            moved_m = np.full((len(ids), 3), [shift_mm / 1000.0, 0.0, 0.0], np.float32)
            moved_m[3] *= 2.0
            influence = Influence(ids, moved_m, chi_square)
            attempt = replace(attempt, influence=influence, checks=graph)
        attempts.append(attempt)
        helped_m.append(told)
    result = replace(run.result, attempts=tuple(attempts))
    return result, replace(run.drift, helped_m=np.array(helped_m)) if helped_mm else None


def test_loops_are_sorted_by_how_far_they_moved_the_map(run):
    result, drift = moving(run, [1.0, 4.0, 2.0], [5.0, 20.0, 3.0])
    told = json.loads(json.dumps(counterfactual(result, drift)))
    assert [each["chi_square"] for each in told["loops"]] == [20.0, 3.0, 5.0]
    assert [each["verdict"] for each in told["loops"]] == ["contradicts", "agrees", "agrees"]
    first = told["loops"][0]
    assert first["moved_most_mm"] == pytest.approx(8.0) and first["moved_most_id"] == 3
    assert first["helped_mm"] is None and first["query_id"] > first["match_id"]
    assert told["loops_moved_mm"] > 0.0


def test_ground_truth_has_the_last_word_on_what_helped(run):
    result, drift = moving(run, [1.0, 4.0], [5.0, 20.0], helped_mm=[-0.5, 2.0])
    (_, most), (_, least) = by_influence(decisions(result, drift))
    assert (most.verdict, least.verdict) == ("helped", "hurt")
    assert most.helped_mm == pytest.approx(2.0)
    sentence = in_words(decisions(result, drift), drift)
    assert "and made the error 2 mm smaller." in sentence
    assert left_out(most).endswith("elsewhere (RMS), its error 2 mm larger")
    assert left_out(least).endswith("elsewhere (RMS), its error 0.5 mm smaller")


@pytest.mark.parametrize(
    ("shares", "said"),
    [
        ([0.5, -0.02, 0.009], "2 of 3 loops change the error by more than 1% (1 helped, 1 hurt)"),
        ([0.5, 0.009, -0.009], "1 of 3 loops changes the error by more than 1% (1 helped, none"),
        ([0.001, 0.009, -0.009], "none of 3 loops changes the error by more than 1%; the one"),
    ],
)
def test_what_nobody_feels_did_not_hurt(run, shares, said):
    """Of loops that agree each alone does next to nothing, half of them to the worse."""
    ate_mm = 1000.0 * run.drift.corrected.ate_rmse_m
    helped_mm = [share * ate_mm for share in shares]
    result, drift = moving(run, [1.0, 4.0, 2.0], [5.0, 3.0, 3.0], helped_mm)
    assert said in in_words(decisions(result, drift), drift)


def test_loops_at_odds_with_the_others_are_counted(run):
    for chi_squares, said in (
        ([5.0, 3.0, 3.0], "none of 3 loops is at odds"),
        ([5.0, 20.0, 3.0], "1 of 3 loops is at odds"),
        ([25.0, 20.0, 3.0], "2 of 3 loops are at odds"),
    ):
        result, _ = moving(run, [1.0, 4.0, 2.0], chi_squares)
        assert said in in_words(decisions(result, None), None)
    (_, odd), (_, agreeing), _ = by_influence(decisions(result, None))
    assert left_out(odd).startswith("without it the map would lie 4.1 mm elsewhere (RMS)")
    assert left_out(odd).endswith("; it contradicts the others")
    assert left_out(agreeing).endswith("; it agrees with the others")


def test_nothing_is_said_where_nothing_is_known(run):
    assert in_words(decisions(run.result, None), None) is None
    assert counterfactual(run.result, None)["loops"] == []

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.output.decision import decisions
from slam.output.report.headline import headline, length


def sentences(run, result=None, **drift_fields) -> list[str]:
    result = result or run.result
    drift = replace(run.drift, **drift_fields)
    return headline(result, drift, decisions(result, drift))


def with_ate(error, ate_m: float):
    return replace(error, ate_rmse_m=ate_m)


@pytest.mark.parametrize(
    ("before_m", "after_m", "words"),
    [
        (0.050, 0.026, "cut the drift from 5.0 cm to 2.6 cm"),
        (0.020, 0.025, "made the drift worse: 2.0 cm became 2.5 cm"),
        (0.020, 0.0201, "left the drift at 2.0 cm"),
        (0.0, 0.0, "left the drift at 0.0 mm"),
    ],
)
def test_the_first_sentence_is_honest(run, before_m, after_m, words) -> None:
    before, after = with_ate(run.drift.before, before_m), with_ate(run.drift.after, after_m)
    first = sentences(run, before=before, after=after)[0]
    assert words in first
    assert "200 of 200 frames compared" in first


def test_every_loop_is_counted_once(run) -> None:
    kinds = [loop.kind for loop in decisions(run.result, run.drift)]
    assert kinds.count("outvoted") > 0
    assert sentences(run)[1] == (
        f"{kinds.count('accepted')} of 60 candidates were accepted, none of them false. "
        f"The pose graph outvoted {kinds.count('outvoted')} more that contradicted the rest."
    )


def test_a_false_loop_is_not_hidden(run) -> None:
    first = next(i for i, one in enumerate(run.drift.loops) if one.is_false is False)
    loops = list(run.drift.loops)
    loops[first] = replace(loops[first], is_false=True)
    assert "accepted, 1 of them false" in sentences(run, loops=tuple(loops))[1]


def test_without_any_loop_none_is_praised(run, altered) -> None:
    rejected = [i for i, one in enumerate(run.result.attempts) if one.weight is None]
    result = altered(attempts=tuple(run.result.attempts[i] for i in rejected))
    found = sentences(run, result, loops=tuple(run.drift.loops[i] for i in rejected))
    assert found[0].startswith("The pose graph, without any loop, cut the drift")
    assert found[1] == f"0 of {len(rejected)} candidates were accepted."


def test_loops_that_truth_cannot_judge_are_named(run) -> None:
    loops = tuple(replace(one, is_false=None) for one in run.drift.loops)
    assert "(ground truth can judge 0)" in sentences(run, loops=loops)[1]


def test_partial_coverage_is_said(run) -> None:
    assert "covers 63% of the sequence's time span" in sentences(run, coverage=0.63)[2]
    assert len(sentences(run)) == 2


def test_without_truth_the_correction_is_given_instead(run) -> None:
    found = headline(run.result, None, decisions(run.result, None))
    assert "moved the camera path by up to" in found[0]
    assert "false" not in " ".join(found)


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.0042, "4.2 mm"), (0.026, "2.6 cm"), (1.234, "1.23 m"), (np.nan, "–")],
)
def test_lengths_come_in_the_unit_people_use(metres: float, text: str) -> None:
    assert length(metres) == text

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.report.decision import decisions
from slam.report.verdict import length, verdict


def sentences(run, result=None, **drift_fields) -> list[str]:
    result = result or run.result
    drift = replace(run.drift, **drift_fields)
    return verdict(result, drift, decisions(result, drift))


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


def test_accepted_and_false_loops_are_counted(run) -> None:
    kinds = [loop.kind for loop in decisions(run.result, run.drift)]
    kept, false = kinds.count("accepted") + kinds.count("false"), kinds.count("false")
    assert f"{kept} of 60 candidates were accepted" in sentences(run)[1]
    assert f"{false or 'none'} of them false" in sentences(run)[1]


def test_a_false_loop_is_not_hidden(run) -> None:
    first = next(i for i, one in enumerate(run.result.attempts) if (one.weight or 0) > 0.5)
    loops = list(run.drift.loops)
    loops[first] = replace(loops[first], is_false=True)
    false = [loop.kind for loop in decisions(run.result, replace(run.drift, loops=tuple(loops)))]
    assert false.count("false") >= 1
    assert f"{false.count('false')} of them false" in sentences(run, loops=tuple(loops))[1]


def test_loops_that_truth_cannot_judge_are_named(run) -> None:
    loops = tuple(replace(one, is_false=None) for one in run.drift.loops)
    assert "(ground truth can judge 0)" in sentences(run, loops=loops)[1]


def test_partial_coverage_and_lost_frames_are_said(run, altered) -> None:
    found = sentences(run, altered(untracked_s=np.array([3.0])), coverage=0.63)
    assert any("covers 63% of the sequence's time span" in one for one in found)
    assert any("1 frame could not be tracked" in one for one in found)
    assert len(sentences(run)) == 2


def test_without_truth_the_correction_is_given_instead(run) -> None:
    found = verdict(run.result, None, decisions(run.result, None))
    assert "moved the camera path by up to" in found[0]
    assert "false" not in " ".join(found)


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.0042, "4.2 mm"), (0.026, "2.6 cm"), (1.234, "1.23 m"), (np.nan, "–")],
)
def test_lengths_come_in_the_unit_people_use(metres: float, text: str) -> None:
    assert length(metres) == text

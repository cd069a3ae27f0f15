# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.evaluation.motion_truth import LoopTruth
from slam.output.decision import decisions
from slam.output.report.headline import figures, headline, length


def sentences(run, result=None, **drift_fields) -> list[str]:
    result = result or run.result
    drift = replace(run.drift, **drift_fields)
    return headline(result, drift, decisions(result, drift))


def with_ate(error, ate_m: float):
    return replace(error, ate_rmse_m=ate_m)


@pytest.mark.parametrize(
    ("without_m", "with_m", "words"),
    [
        (0.050, 0.026, "Loop closure cut the drift from 5.00 cm (without loops) to 2.60 cm"),
        (0.020, 0.025, "Loop closure made the drift worse: 2.00 cm (without loops) became 2.50 cm"),
        (0.0201, 0.02, "changed nothing here: the drift is 2.00 cm with loops and 2.01 cm without"),
        (0.0, 0.0, "changed nothing here: the drift is 0.00 mm with loops and 0.00 mm without"),
    ],
)
def test_the_first_sentence_is_honest(run, without_m, with_m, words) -> None:
    without_loops = with_ate(run.drift.without_loops, without_m)
    first = sentences(
        run, without_loops=without_loops, corrected=with_ate(run.drift.corrected, with_m)
    )[0]
    assert words in first
    assert "200 of 200 frames compared" in first


@pytest.mark.parametrize(
    ("odometry_m", "without_m", "words"),
    [
        (0.0137, 0.0109, "cut the odometry's drift from 1.37 cm to 1.09 cm."),
        (0.0109, 0.0137, "raised the odometry's drift from 1.09 cm to 1.37 cm."),
        (0.0137, 0.0136, "left the odometry's drift at 1.37 cm."),
    ],
)
def test_what_adjusting_the_map_did_is_not_credited_to_loops(
    run, odometry_m, without_m, words
) -> None:
    odometry = with_ate(run.drift.odometry, odometry_m)
    without_loops = with_ate(run.drift.without_loops, without_m)
    corrected = with_ate(run.drift.corrected, without_m)
    found = sentences(run, odometry=odometry, without_loops=without_loops, corrected=corrected)
    assert found[0].startswith("Loop closure changed nothing here")
    assert found[1] == f"Adjusting the map, without loops, {words}"


def test_every_loop_is_counted_once(run) -> None:
    kinds = [loop.kind for loop in decisions(run.result, run.drift)]
    assert kinds.count("outvoted") > 0
    assert sentences(run)[2] == (
        f"{kinds.count('accepted')} of 60 candidates were accepted, none of them false. "
        f"The pose graph outvoted {kinds.count('outvoted')} more that contradicted the rest."
    )


def test_a_false_loop_is_not_hidden(run) -> None:
    first = next(i for i, one in enumerate(run.drift.loops) if one.is_false is False)
    loops = list(run.drift.loops)
    loops[first] = replace(loops[first], is_false=True)
    assert "accepted, 1 of them false" in sentences(run, loops=tuple(loops))[2]


def test_without_any_loop_none_is_praised(run, altered) -> None:
    rejected = [i for i, one in enumerate(run.result.attempts) if one.weight is None]
    result = altered(attempts=tuple(run.result.attempts[i] for i in rejected))
    found = sentences(run, result, loops=tuple(run.drift.loops[i] for i in rejected))
    assert found[0].startswith("No loop was closed; the drift is ")
    assert found[2] == f"0 of {len(rejected)} candidates were accepted."


def test_loops_that_truth_cannot_judge_are_named(run) -> None:
    loops = tuple(replace(one, is_false=None) for one in run.drift.loops)
    assert "(ground truth can judge 0)" in sentences(run, loops=loops)[2]


def test_where_truth_says_nothing_of_turning_no_loop_is_called_right_or_false(run) -> None:
    unknown = tuple(LoopTruth() for _ in run.drift.loops)
    found = sentences(run, loops=unknown, unjudged="the truth has no orientations")[2]
    said = "candidates were accepted; which of them are false is not known: the truth has no"
    assert f"of 60 {said} orientations." in found
    assert "none of them" not in found


def test_partial_coverage_is_said(run) -> None:
    assert "covers 63% of the sequence's time span" in sentences(run, coverage=0.63)[3]
    assert len(sentences(run)) == 3


def test_without_truth_it_says_how_far_loops_moved_the_path(run, altered) -> None:
    moved = run.result.without_loops.T_world_cam.copy()
    moved[:, 2, 3] += np.linspace(0.0, 0.5, len(moved))
    result = altered(trajectory=replace(run.result.trajectory, T_world_cam=moved))
    found = headline(result, None, decisions(result, None))
    assert found[0].startswith(
        "Loop closure moved the camera path by up to 50.0 cm (25.0 cm on average)."
    )
    assert "false" not in " ".join(found)


def test_smoothing_is_not_credited_to_loops(run, altered) -> None:
    """What counts is the corrected path before it was smoothed."""
    result = altered(unsmoothed=run.result.without_loops)
    assert "by up to 0.00 mm" in headline(result, None, decisions(result, None))[0]


def test_without_truth_or_loops_nothing_was_moved(run, altered) -> None:
    result = altered(attempts=())
    found = headline(result, None, [])
    assert found[0].startswith("No loop was closed, so none moved the camera path.")


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (0.0042, "4.20 mm"),
        (0.0107, "1.07 cm"),
        (0.26, "26.0 cm"),
        (1.234, "1.23 m"),
        (12.34, "12.3 m"),
        (np.nan, "–"),
    ],
)
def test_lengths_come_in_the_unit_people_use(metres: float, text: str) -> None:
    assert length(metres) == text


def test_three_numbers_answer_first(run, altered) -> None:
    loops = decisions(run.result, run.drift)
    error, closed, tracked = figures(run.result, run.drift, loops)
    assert error.value == length(run.drift.corrected.ate_rmse_m)
    assert error.note.startswith("without loops ") and ", odometry " in error.note
    kept = sum(loop.attempt.rejection is None for loop in loops)
    assert closed.value == f"{kept} of 60"
    assert closed.note == "none false by ground truth; 2 more outvoted by the rest"
    assert (tracked.value, tracked.note) == ("200 of 200", "40 keyframes, 20.0 ms per frame")


def test_what_the_compiler_took_of_a_frame_is_told(run, altered) -> None:
    *_, tracked = figures(altered(compiling_s=3.0), None, [])
    assert tracked.note == "40 keyframes, 20.0 ms per frame, 15.0 of them compiling"


def test_an_error_that_nobody_knows_is_told_calmly(run) -> None:
    error, closed, _ = figures(run.result, None, decisions(run.result, None))
    assert error.value == "not known"
    assert error.note == "no ground truth to compare with"
    assert "false" not in closed.note


@pytest.mark.parametrize("judged", [0, 1])
def test_of_loops_that_truth_cannot_judge_nothing_is_claimed(run, judged) -> None:
    known = [one for one in run.drift.loops if one.is_false is not None]
    loops = tuple(
        one if any(one is each for each in known[:judged]) else replace(one, is_false=None)
        for one in run.drift.loops
    )
    drift = replace(run.drift, loops=loops)
    found = decisions(run.result, drift)
    used = sum(each.attempt.rejection is None and each.truth.is_false is not None for each in found)
    note = figures(run.result, drift, found)[1].note
    assert ("false by ground truth" in note) == (used > 0)
    assert (f"of {used} judged false" in note) == (used > 0)

# SPDX-License-Identifier: Apache-2.0
import csv
import io
import json
from dataclasses import replace

import pytest

from slam.output.comparison.tables import as_text
from slam.output.stress.outcome import Outcome, read_outcome, write_outcome
from slam.output.stress.plots import curves
from slam.output.stress.tolerance import as_files, table, tolerated

CLEAN = Outcome("clean", 0.0, 0.03, 0.02, 0.01, True, 100, 100, 40, 0, 0, ())


def blurred(level, ate_m=0.01, **other):
    return replace(CLEAN, stressor="blur", level=level, ate_m=ate_m, **other)


def test_tolerated_is_what_holds_up_to_there_with_most_frames():
    assert tolerated(CLEAN, [blurred(0.1), blurred(0.2, 0.0109), blurred(0.3, 0.0111)]) == 0.2
    assert tolerated(CLEAN, [blurred(0.1, 0.02), blurred(0.2)]) == 0.0
    assert tolerated(CLEAN, [blurred(0.1), blurred(0.2, frames_tracked=80)]) == 0.1
    assert tolerated(CLEAN, [blurred(0.1, None)]) == 0.0
    assert tolerated(CLEAN, []) is None
    unknown = replace(CLEAN, ate_m=None)
    assert tolerated(unknown, [blurred(0.1)]) is None
    assert "blur unknown" in dict(table("", unknown, {"blur": [blurred(0.1)]}).notes)["tolerated"]


def test_loops_that_do_harm_are_marked_and_so_is_a_warning():
    worse = blurred(0.1, 0.021)
    said = replace(worse, level=0.2, warnings=("a warning",))
    assert worse.is_worse and said.is_worse and not CLEAN.is_worse
    rows = table("title", CLEAN, {"blur": [worse, said]}).rows
    assert [row[-1] for row in rows] == ["", "!", "w!"]


def test_files_and_picture_tell_all_of_it_and_are_always_the_same():
    ended = Outcome("blur", 0.3, None, None, None, True, 100, 0, 0, 0, 0, (), "nothing tracked")
    trials = {"blur": [blurred(0.1), ended], "false-loops": [blurred(0.1, false_injected=9)]}
    files = as_files(CLEAN, trials, {"seed": 3})
    told = json.loads(files["tolerance.json"])
    assert told["seed"] == 3 and told["stressors"]["blur"]["tolerated"] == 0.1
    rows = list(csv.DictReader(io.StringIO(files["tolerance.csv"])))
    assert len(rows) == 4 and rows[2]["ate_m"] == "" and rows[3]["false_injected"] == "9"
    drawn = curves(CLEAN, trials)
    assert drawn == curves(CLEAN, trials) and b"share of all loops" in drawn["tolerance.svg"]


def test_without_truth_it_is_said_that_distances_are_no_errors():
    clean = replace(CLEAN, has_truth=False, ate_m=0.0)
    trials = {"blur": [replace(blurred(0.1, 0.015), has_truth=False)]}
    text = as_text(table("title", clean, trials))
    assert "there is no ground truth" in text and tolerated(clean, trials["blur"]) == 0.1
    assert b"from the clean run" in curves(clean, trials)["tolerance.svg"]


@pytest.mark.parametrize("content", [None, "{", "[]", '{"stressor": "blur", "warnings": []}'])
def test_an_outcome_is_read_back_and_what_is_none_is_not(tmp_path, content):
    path = tmp_path / "blur-0.1.json"
    write_outcome(path, blurred(0.1, warnings=("one",)))
    assert read_outcome(path) == blurred(0.1, warnings=("one",))
    path.unlink() if content is None else path.write_text(content)
    assert read_outcome(path) is None

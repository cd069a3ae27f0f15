# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from datetime import date

from placerec.evaluation.measurement import Failed
from placerec.evaluation.tables import HEADER, evaluation_table, notes


def test_markdown_table_lines_up(measured):
    other = replace(measured, recognizer="longer than the column's name")
    lines = evaluation_table([measured, other]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert len(lines) == 4
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    assert len(cells) == len(HEADER)
    assert " ".join(cells) == "walk short 0.750 0.250 0.500 0.750 0.500 0.625 512 2.0 12.3 0.123"
    assert set(lines[1]) == set("|-: ")


def test_a_failure_says_why_and_does_not_widen_the_table(measured):
    why = "a sentence that is a good deal longer than any of the columns | or so"
    failed = Failed(measured.dataset, "short", why)
    lines = evaluation_table([measured, failed]).splitlines()
    assert lines[:3] == evaluation_table([measured]).splitlines()
    assert lines[3].startswith("| walk | short      | failed: a sentence that")
    assert lines[3].count("|") - lines[3].count(r"\|") == 4
    assert len(evaluation_table([failed]).splitlines()) == 3


def test_what_the_table_does_not_say_is_noted_below(measured):
    assert notes([measured]) == []
    kept = replace(measured, weights="ImageNet", trained_on=("walk",), timed_on=date(2026, 2, 3))
    assert " 12.3* |" in evaluation_table([kept])
    assert notes([kept, kept, Failed(measured.dataset, "other", "why")]) == [
        "short: ImageNet",
        "short was trained on walk",
        "* timed when the kept embeddings were made, the oldest on 2026-02-03; "
        "--no-cache makes them anew",
    ]

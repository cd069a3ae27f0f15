# SPDX-License-Identifier: Apache-2.0
import csv
from dataclasses import replace
from datetime import date

from placerec.evaluation.measurement import Failed
from placerec.evaluation.tables import evaluation_csv, evaluation_table, notes


def test_markdown_table_lines_up(measured):
    other = replace(measured, recognizer="longer than the column's name")
    lines = evaluation_table([measured, other]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert len(lines) == 4
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    assert len(cells) == 12
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


def test_every_figure_is_in_full_under_its_name(measured):
    kept = replace(measured, weights="two, words", trained_on=("walk",), timed_on=date(2026, 2, 3))
    rows = list(csv.DictReader(evaluation_csv([measured, kept]).splitlines()))
    assert rows[0] == {
        "data": "walk",
        "recognizer": "short",
        "weights": "",
        "trained_on": "",
        "images": "4",
        "pairs": "4",
        "average_precision": "0.75",
        "average_precision_low": "0.5",
        "average_precision_high": "0.9",
        "recall_at_1": "0.25",
        "recall_at_5": "0.5",
        "recall_at_10": "0.75",
        "recall_at_full_precision": "0.5",
        "recall_at_full_precision_low": "0.125",
        "recall_at_full_precision_high": "0.6",
        "best_match_area": "0.625",
        "dimension": "512",
        "bytes_per_place": "2048",
        "embed_ms": "12.34",
        "embed_timed_on": "",
        "compare_ms": "0.000123",
        "failure": "",
    }
    marks = [rows[1][name] for name in ("weights", "trained_on", "embed_timed_on")]
    assert marks == ["two, words", "walk", "2026-02-03"]


def test_a_failure_has_no_figures(measured):
    (row,) = csv.DictReader(evaluation_csv([Failed(measured.dataset, "x", "a, b")]).splitlines())
    assert {name for name, value in row.items() if value} == {
        "data",
        "recognizer",
        "images",
        "pairs",
        "failure",
    }
    assert row["failure"] == "a, b"
    assert evaluation_csv([measured]).startswith(",".join(row) + "\n")


def test_a_name_is_no_formula_to_a_spreadsheet(measured):
    names = ('=HYPERLINK("http://x")', "+1", "-1", "@a", "\t=1", "plain")
    rows = [replace(measured, recognizer=name) for name in names]
    failed = Failed(measured.dataset, "=1", "=2\n")
    (*read, last) = csv.DictReader(evaluation_csv([*rows, failed]).splitlines())
    assert [row["recognizer"] for row in read] == [
        '\'=HYPERLINK("http://x")',
        "'+1",
        "'-1",
        "'@a",
        r"\t=1",
        "plain",
    ]
    assert (last["recognizer"], last["failure"]) == ("'=1", r"'=2\n")

# SPDX-License-Identifier: Apache-2.0
import csv
from dataclasses import replace
from datetime import date

from placerec.evaluation.measurement import Failed
from placerec.evaluation.tables import CSV_COLUMNS, evaluation_csv


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
    assert tuple(row) == CSV_COLUMNS

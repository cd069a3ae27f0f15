# SPDX-License-Identifier: Apache-2.0
"""Measurements in full, as a CSV file."""

import csv
import io
from collections.abc import Sequence

from placerec.measurement import Failed, Measurement

HEADER = (
    "data",
    "recognizer",
    "weights",
    "trained_on",
    "images",
    "pairs",
    "average_precision",
    "average_precision_low",
    "average_precision_high",
    "recall_at_1",
    "recall_at_5",
    "recall_at_10",
    "recall_at_full_precision",
    "recall_at_full_precision_low",
    "recall_at_full_precision_high",
    "best_match_area",
    "dimension",
    "bytes_per_place",
    "embed_ms",
    "embed_timed_on",
    "compare_ms",
    "failure",
)


def evaluation_csv(rows: Sequence[Measurement]) -> str:
    """Return the figures in full, a line per evaluation; unknown ones are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, HEADER, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(_figures(row) for row in rows)
    return text.getvalue()


def _figures(row: Measurement) -> dict[str, object]:
    names: dict[str, object] = {
        "data": row.dataset.name,
        "recognizer": row.recognizer,
        "images": len(row.dataset),
        "pairs": int(row.dataset.pairs.sum()),
    }
    if isinstance(row, Failed):
        return {**names, "failure": row.why}
    found, cost = row.evaluation, row.cost
    precision, recall = row.intervals.average_precision, row.intervals.recall_at_full_precision
    return {
        **names,
        "weights": row.weights,
        "trained_on": " ".join(row.trained_on),
        "average_precision": found.pair_curve.area,
        "average_precision_low": precision[0],
        "average_precision_high": precision[1],
        "recall_at_1": found.recall_at_1,
        "recall_at_5": found.recall_at_5,
        "recall_at_10": found.recall_at_10,
        "recall_at_full_precision": found.best_match_curve.recall_at_full_precision,
        "recall_at_full_precision_low": recall[0],
        "recall_at_full_precision_high": recall[1],
        "best_match_area": found.best_match_curve.area,
        "dimension": cost.dimension,
        "bytes_per_place": cost.embedding_bytes,
        "embed_ms": cost.embed_ms,
        "embed_timed_on": row.timed_on or "",
        "compare_ms": cost.compare_ms,
    }

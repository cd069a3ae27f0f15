# SPDX-License-Identifier: Apache-2.0
"""Measurements side by side: as a Markdown table that is legible as it stands, and as CSV."""

import csv
import io
from collections.abc import Sequence

from placerec.evaluation.measurement import Failed, Measured, Measurement

CSV_COLUMNS = (
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
    writer = csv.DictWriter(text, CSV_COLUMNS, restval="", lineterminator="\n")
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


HEADER = (
    "data",
    "recognizer",
    "pair AP",
    "recall@1",
    "recall@5",
    "recall@10",
    "recall at 100 % P",
    "best-match area",
    "values",
    "KiB",
    "embed ms",
    "compare µs",
)
NAMES = 2
"""So many columns are names, written from the left; the others are numbers."""
EARLIER = "*"
"""Marks a time that was measured in an earlier run."""

LEGEND = (
    "Pair AP: average precision over all pairs of images that count. Recall@k: queries with a "
    "right\none among their k most similar references. Recall at 100 % precision and area: of the "
    "curve of\neach query's best match. Embed: median per image. Compare: per pair, in a batch of "
    "10,000."
)


def evaluation_table(rows: Sequence[Measurement]) -> str:
    """Return one line per evaluation; the two recalls and the area are of best matches."""
    cells = [HEADER, *(_cells(row) for row in rows)]
    # Why something failed may run on beyond its column.
    whole = [row if len(row) == len(HEADER) else (*row[:NAMES], *HEADER[NAMES:]) for row in cells]
    widths = [max(map(len, column)) for column in zip(*whole, strict=True)]
    rule = ["-" * width if i < NAMES else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    return "\n".join(_line(row, widths) for row in (cells[0], rule, *cells[1:]))


def notes(rows: Sequence[Measurement]) -> list[str]:
    """Return what must be known to read the table, a line each: weights, marks."""
    measured = [row for row in rows if isinstance(row, Measured)]
    weights = {row.recognizer: row.weights for row in measured if row.weights}
    seen = {(row.recognizer, part) for row in measured for part in row.trained_on}
    days = [row.timed_on for row in measured if row.timed_on]
    lines = [f"{name}: {line}" for name, line in weights.items()]
    lines += [f"{name} was trained on {part}" for name, part in sorted(seen)]
    if days:
        lines.append(
            f"{EARLIER} timed when the kept embeddings were made, the oldest on {min(days)}; "
            "--no-cache makes them anew"
        )
    return lines


def _cells(row: Measurement) -> tuple[str, ...]:
    if isinstance(row, Failed):
        return row.dataset.name, row.recognizer, f"failed: {row.why}".replace("|", r"\|")
    found, cost = row.evaluation, row.cost
    return (
        row.dataset.name,
        row.recognizer,
        f"{found.pair_curve.area:.3f}",
        f"{found.recall_at_1:.3f}",
        f"{found.recall_at_5:.3f}",
        f"{found.recall_at_10:.3f}",
        f"{found.best_match_curve.recall_at_full_precision:.3f}",
        f"{found.best_match_curve.area:.3f}",
        f"{cost.dimension}",
        f"{cost.embedding_bytes / 1024:.1f}",
        f"{cost.embed_ms:.1f}{EARLIER if row.timed_on else ''}",
        f"{1e3 * cost.compare_ms:.3f}",
    )


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [
        cell.ljust(width) if i < NAMES else cell.rjust(width)
        for i, (cell, width) in enumerate(zip(cells, widths, strict=False))
    ]
    return f"| {' | '.join(padded)} |"

# SPDX-License-Identifier: Apache-2.0
"""Measurements side by side: as a Markdown table that is legible as it stands, and as CSV."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence

from placerec.errors import printable
from placerec.evaluation.measurement import Failed, Measured, Measurement

EARLIER = "*"
"""Marks a time that was measured in an earlier run."""

LEGEND = (
    "Pair AP: average precision over all pairs of images that count. Recall@k: queries with a "
    "right\none among their k most similar references. Recall at 100 % precision and area: of the "
    "curve of\neach query's best match. Embed: median per image. Compare: per pair, in a batch of "
    "10,000."
)

_CSV: dict[str, Callable[[Measured], object]] = {
    "data": lambda row: row.dataset.name,
    "recognizer": lambda row: row.recognizer,
    "weights": lambda row: row.weights,
    "trained_on": lambda row: " ".join(row.trained_on),
    "images": lambda row: len(row.dataset),
    "pairs": lambda row: int(row.dataset.pairs.sum()),
    "average_precision": lambda row: row.evaluation.pair_curve.area,
    "average_precision_low": lambda row: row.intervals.average_precision[0],
    "average_precision_high": lambda row: row.intervals.average_precision[1],
    "recall_at_1": lambda row: row.evaluation.recall_at_1,
    "recall_at_5": lambda row: row.evaluation.recall_at_5,
    "recall_at_10": lambda row: row.evaluation.recall_at_10,
    "recall_at_full_precision": lambda row: (
        row.evaluation.best_match_curve.recall_at_full_precision
    ),
    "recall_at_full_precision_low": lambda row: row.intervals.recall_at_full_precision[0],
    "recall_at_full_precision_high": lambda row: row.intervals.recall_at_full_precision[1],
    "best_match_area": lambda row: row.evaluation.best_match_curve.area,
    "dimension": lambda row: row.cost.dimension,
    "bytes_per_place": lambda row: row.cost.embedding_bytes,
    "embed_ms": lambda row: row.cost.embed_ms,
    "embed_timed_on": lambda row: row.timed_on or "",
    "compare_ms": lambda row: row.cost.compare_ms,
    "failure": lambda row: "",
}

_TABLE: dict[str, Callable[[Measured], str]] = {
    "data": lambda row: row.dataset.name,
    "recognizer": lambda row: row.recognizer,
    "pair AP": lambda row: f"{row.evaluation.pair_curve.area:.3f}",
    "recall@1": lambda row: f"{row.evaluation.recall_at_1:.3f}",
    "recall@5": lambda row: f"{row.evaluation.recall_at_5:.3f}",
    "recall@10": lambda row: f"{row.evaluation.recall_at_10:.3f}",
    "recall at 100 % P": lambda row: (
        f"{row.evaluation.best_match_curve.recall_at_full_precision:.3f}"
    ),
    "best-match area": lambda row: f"{row.evaluation.best_match_curve.area:.3f}",
    "values": lambda row: f"{row.cost.dimension}",
    "KiB": lambda row: f"{row.cost.embedding_bytes / 1024:.1f}",
    "embed ms": lambda row: f"{row.cost.embed_ms:.1f}{EARLIER if row.timed_on else ''}",
    "compare µs": lambda row: f"{1e3 * row.cost.compare_ms:.3f}",
}
_NAMES = 2
"""So many columns of it are names."""


def evaluation_csv(rows: Sequence[Measurement]) -> str:
    """Return the figures in full, a line per evaluation; unknown ones are empty."""
    return csv_text(tuple(_CSV), [_figures(row) for row in rows])


def _figures(row: Measurement) -> dict[str, object]:
    if isinstance(row, Measured):
        return {name: figure(row) for name, figure in _CSV.items()}
    names: dict[str, object] = {"data": row.dataset.name, "recognizer": row.recognizer}
    names |= {"images": len(row.dataset), "pairs": int(row.dataset.pairs.sum())}
    return names | {"failure": row.why}


def csv_text(columns: Sequence[str], rows: Sequence[Mapping[str, object]]) -> str:
    """Return a line for each row, below the columns' names; what a row does not tell is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: _cell(value) for name, value in row.items()})
    return text.getvalue()


def _cell(value: object) -> object:
    """Return what a spreadsheet shows as it is, and does not take for a formula."""
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def evaluation_table(rows: Sequence[Measurement]) -> str:
    """Return one line per evaluation; the two recalls and the area are of best matches."""
    return markdown_table(tuple(_TABLE), [_cells(row) for row in rows], _NAMES)


def markdown_table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]], names: int) -> str:
    """Return rows as a Markdown table that is legible as it stands.

    Args:
        header: of the columns.
        rows: of one that failed, the names, and why it did.
        names: so many columns are written from the left; the others are numbers.
    """
    # Why something failed may run on beyond its column.
    whole = [row if len(row) == len(header) else (*row[:names], *header[names:]) for row in rows]
    widths = [max(map(len, column)) for column in zip(header, *whole, strict=True)]
    rule = ["-" * width for width in widths[:names]]
    rule += ["-" * (width - 1) + ":" for width in widths[names:]]
    return "\n".join(_line(row, widths, names) for row in (header, rule, *rows))


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
    return tuple(figure(row) for figure in _TABLE.values())


def _line(cells: Sequence[str], widths: Sequence[int], names: int) -> str:
    padded = [
        cell.ljust(width) if i < names else cell.rjust(width)
        for i, (cell, width) in enumerate(zip(cells, widths, strict=False))
    ]
    return f"| {' | '.join(padded)} |"

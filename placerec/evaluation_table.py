# SPDX-License-Identifier: Apache-2.0
"""Measurements side by side, as a Markdown table that is legible as it stands."""

from collections.abc import Sequence

from placerec.measurement import Failed, Measured, Measurement

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

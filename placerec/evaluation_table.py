# SPDX-License-Identifier: Apache-2.0
"""Evaluations side by side, as a Markdown table that is legible as it stands."""

from collections.abc import Sequence
from typing import NamedTuple

from placerec.cost import Cost
from placerec.evaluation import Evaluation

HEADER = (
    "data",
    "recognizer",
    "pair AP",
    "recall@1",
    "recall@5",
    "recall at 100 % P",
    "best-match area",
    "values",
    "KiB",
    "embed ms",
    "compare µs",
)
NAMES = 2
"""So many columns are names, written from the left; the others are numbers."""

LEGEND = (
    "Pair AP: average precision over all pairs of images that count. Recall@k: queries with a "
    "right\none among their k most similar references. Recall at 100 % precision and area: of the "
    "curve of\neach query's best match. Embed: median per image. Compare: per pair, in a batch of "
    "10,000."
)


class Measured(NamedTuple):
    """A recognizer on a dataset."""

    data: str
    recognizer: str
    evaluation: Evaluation
    cost: Cost


def evaluation_table(rows: Sequence[Measured]) -> str:
    """Return one line per evaluation; the two recalls and the area are of best matches."""
    cells = [HEADER, *(_cells(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    rule = ["-" * width if i < NAMES else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    return "\n".join(_line(row, widths) for row in (cells[0], rule, *cells[1:]))


def _cells(row: Measured) -> tuple[str, ...]:
    found, cost = row.evaluation, row.cost
    return (
        row.data,
        row.recognizer,
        f"{found.pair_curve.area:.3f}",
        f"{found.recall_at_1:.3f}",
        f"{found.recall_at_5:.3f}",
        f"{found.best_match_curve.recall_at_full_precision:.3f}",
        f"{found.best_match_curve.area:.3f}",
        f"{cost.dimension}",
        f"{cost.embedding_bytes / 1024:.1f}",
        f"{cost.embed_ms:.1f}",
        f"{1e3 * cost.compare_ms:.3f}",
    )


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [
        cell.ljust(width) if i < NAMES else cell.rjust(width)
        for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
    ]
    return f"| {' | '.join(padded)} |"

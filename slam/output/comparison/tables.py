# SPDX-License-Identifier: Apache-2.0
"""Tables as text for a terminal, as LaTeX for a paper, and as CSV."""

import csv
import io
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from placerec.errors import printable

_WIDTH = 80
_NAME = 10
_LATEX = {
    "\\": r"\textbackslash{}",
    **{each: rf"\{each}" for each in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}
Notes = Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """Figures and what stands behind them.

    Attributes:
        title: of the table.
        header: the names of the columns.
        rows: as they are shown.
        notes: what stands behind the figures: a name and a sentence each.
        texts: how many columns, from the left, are no numbers.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[tuple[str, str], ...]
    texts: int = 1


def as_text(table: Table) -> str:
    """Return a table for a terminal, its notes below it."""
    lines = [table.header, *table.rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    shown = [
        "  ".join(
            f"{cell:<{width}}" if i < table.texts else f"{cell:>{width}}"
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
    return "\n".join(map(printable, [table.title, "", *shown, "", *_notes(table.notes)]))


def _notes(notes: Notes) -> Iterable[str]:
    for name, text in notes:
        yield from textwrap.wrap(
            text,
            _WIDTH,
            initial_indent=f"{name:<{_NAME}} ",
            subsequent_indent=" " * (_NAME + 1),
            break_long_words=False,
            break_on_hyphens=False,
        )


def as_latex(tables: Iterable[Table]) -> str:
    """Return tables for a paper that uses booktabs, each with its notes below it."""
    return "".join(_latex(table) for table in tables)


def _latex(table: Table) -> str:
    columns = "l" * table.texts + "r" * (len(table.header) - table.texts)
    notes = " ".join(f"{name}: {text}." for name, text in table.notes)
    return "\n".join(
        [
            "% \\usepackage{booktabs}",
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_escaped(table.title)}}}",
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            _latex_row(table.header),
            r"\midrule",
            *map(_latex_row, table.rows),
            r"\bottomrule",
            r"\end{tabular}",
            rf"\\[1ex]\parbox{{\linewidth}}{{\footnotesize {_escaped(notes)}}}",
            r"\end{table}",
            "",
        ]
    )


def _latex_row(cells: Iterable[str]) -> str:
    return " & ".join(map(_escaped, cells)) + r" \\"


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in " ".join(text.split()))


def as_csv(rows: Sequence[dict[str, object]]) -> str:
    """Return rows in full, under the keys of the one with most; what is not known is empty."""
    stream = io.StringIO()
    fullest = max(rows, key=len)
    writer = csv.DictWriter(stream, list(fullest), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()

# SPDX-License-Identifier: Apache-2.0
"""A table as a page for a browser: one file, without scripts, that works offline."""

from collections.abc import Mapping
from html import escape
from urllib.parse import quote

from placerec.errors import printable
from slam.output.comparison.tables import Table

_STYLE = """
:root { --paper: #f4f5f7; --ink: #20242a; --soft: #5b636e; --line: #d9dde3; --link: #0a64b4; }
body { margin: 0 auto; padding: 1.5rem 1rem; max-width: 1240px; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.3; overflow-wrap: anywhere; }
div { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .32rem .7rem; border-bottom: 1px solid var(--line); }
th { white-space: nowrap; font-weight: 600; }
.n { text-align: right; white-space: nowrap; }
a { color: var(--link); text-decoration: none; }
a:hover { text-decoration: underline; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1rem; color: var(--soft);
  font-size: .9rem; }
dd { margin: 0; max-width: 90ch; overflow-wrap: anywhere; }
"""


def as_page(table: Table, links: Mapping[str, str]) -> str:
    """Return a table as HTML, its notes below it.

    The links are paths beside the page, by what stands in the first column.
    """
    head = "".join(_cell("th", text, i >= table.texts) for i, text in enumerate(table.header))
    rows = [_row(row, table.texts, links.get(row[0], "")) for row in table.rows]
    notes = [f"<dt>{_shown(name)}</dt><dd>{_shown(text)}</dd>" for name, text in table.notes]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{_shown(table.title)}</title>",
            '<link rel="icon" href="data:,">',
            f"<style>{_STYLE}</style>",
            "</head>",
            "<body>",
            f"<h1>{_shown(table.title)}</h1>",
            "<div><table>",
            f"<thead><tr>{head}</tr></thead>",
            "<tbody>",
            *rows,
            "</tbody>",
            "</table></div>",
            "<dl>",
            *notes,
            "</dl>",
            "</body>",
            "</html>",
            "",
        ]
    )


def _row(row: tuple[str, ...], texts: int, link: str) -> str:
    first = _shown(row[0])
    if link:
        first = f'<a href="{escape(quote(link))}">{first}</a>'
    others = "".join(_cell("td", text, i >= texts) for i, text in enumerate(row[1:], start=1))
    return f"<tr><td>{first}</td>{others}</tr>"


def _cell(kind: str, text: str, is_number: bool) -> str:
    of_numbers = ' class="n"' if is_number else ""
    return f"<{kind}{of_numbers}>{_shown(text)}</{kind}>"


def _shown(text: str) -> str:
    return escape(printable(text))

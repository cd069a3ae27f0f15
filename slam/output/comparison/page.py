# SPDX-License-Identifier: Apache-2.0
"""A table as a page for a browser: one file, without scripts, that works offline."""

from collections.abc import Mapping

import jinja2

from placerec.errors import printable
from slam.output.comparison.tables import Table

_TEMPLATE = "page.html"


def as_page(table: Table, links: Mapping[str, str]) -> str:
    """Return a table as HTML, its notes below it.

    The links are paths beside the page, by what stands in the first column.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("slam.output.comparison", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["printable"] = printable
    return environment.get_template(_TEMPLATE).render(table=table, links=links)

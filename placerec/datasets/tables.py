# SPDX-License-Identifier: Apache-2.0
"""Tables as datasets come with them."""

import csv
from collections.abc import Iterator
from pathlib import Path

from placerec.errors import RecognizerError
from placerec.files import read_text


def read_csv(file: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield (line number, the named columns' values) of a file with a header.

    Blanks behind a comma do not count.

    Raises:
        RecognizerError: it cannot be read as text, a column is missing or a line too short.
    """
    reader = csv.reader(read_text(file, kind=RecognizerError).splitlines(), skipinitialspace=True)
    try:
        rows = [(reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        raise RecognizerError(f"line {reader.line_num} of the table: {error}: {file}") from error
    header = rows[0][1] if rows else []
    missing = [column for column in columns if column not in header]
    if missing:
        raise RecognizerError(f"the table has no column {' or '.join(missing)}: {file}")
    indices = [header.index(column) for column in columns]
    for number, row in rows[1:]:
        if len(row) <= max(indices):
            raise RecognizerError(f"line {number} of the table is too short: {file}")
        yield number, tuple(row[i] for i in indices)

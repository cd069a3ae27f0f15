# SPDX-License-Identifier: Apache-2.0
"""Text files as datasets come with them."""

import csv
from collections.abc import Iterator
from pathlib import Path

from placerec.errors import LoopcloseError


def read_csv(file: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield (line number, the named columns' values) of a file with a header.

    Blanks behind a comma do not count.

    Raises:
        LoopcloseError: it cannot be read as text, a column is missing or a line too short.
    """
    reader = csv.DictReader(read_text(file).splitlines(), skipinitialspace=True)
    missing = [column for column in columns if column not in (reader.fieldnames or ())]
    if missing:
        raise LoopcloseError(f"the table has no column {' or '.join(missing)}: {file}")
    for row in reader:
        values = tuple(row[column] for column in columns)
        if None in values:
            raise LoopcloseError(f"line {reader.line_num} of the table is too short: {file}")
        yield reader.line_num, values


def read_text(file: Path) -> str:
    """Return what a file in UTF-8 holds, without the mark that some editors begin it with.

    Raises:
        LoopcloseError: it cannot be read or is not text.
    """
    try:
        return file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LoopcloseError(f"cannot read {file.name}: {error.strerror}: {file}") from error
    except UnicodeDecodeError as error:
        raise LoopcloseError(f"{file.name} is not text in UTF-8: {file}") from error

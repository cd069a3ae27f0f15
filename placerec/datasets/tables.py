# SPDX-License-Identifier: Apache-2.0
"""Text files of rows, as datasets come with them."""

import csv
from collections.abc import Iterator
from pathlib import Path

from placerec.errors import RecognizerError


def read_rows(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, fields) of a file separated by blanks, without comments.

    Raises:
        RecognizerError: it cannot be read as text.
    """
    for number, line in enumerate(_text(file).splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if fields and not fields[0].startswith("#"):
            yield number, fields


def read_csv(file: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield (line number, the named columns' values) of a file with a header.

    Raises:
        RecognizerError: it cannot be read as text, a column is missing or a line too short.
    """
    reader = csv.DictReader(_text(file).splitlines())
    missing = [column for column in columns if column not in (reader.fieldnames or ())]
    if missing:
        raise RecognizerError(f"the table has no column {' or '.join(missing)}: {file}")
    for row in reader:
        values = tuple(row[column] for column in columns)
        if None in values:
            raise RecognizerError(f"line {reader.line_num} of the table is too short: {file}")
        yield reader.line_num, values


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RecognizerError(f"cannot read {file.name}: {error.strerror}: {file}") from error
    except UnicodeDecodeError as error:
        raise RecognizerError(f"{file.name} is not text in UTF-8: {file}") from error

# SPDX-License-Identifier: Apache-2.0
"""Text files with a record per line, as recordings hold them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slam.types import FloatArray, SlamError


def read_lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield (line number, text) of the lines that hold data: no comment, not empty.

    Raises:
        SlamError: the file cannot be read or is not text.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise SlamError(f"cannot read the list: {error.strerror}: {file}") from error
    except UnicodeDecodeError as error:
        raise SlamError(f"the list is not text in UTF-8: {file}") from error
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def as_numbers(fields: list[str]) -> list[float] | None:
    """Return the fields as finite numbers, or None where one is none."""
    try:
        values = [float(field) for field in fields]
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def in_order(stamps_s: FloatArray, file: Path, warnings: list[str]) -> list[int]:
    """Return which of (N,) times to keep, in the order of time: of equal ones the first."""
    order = np.argsort(stamps_s, kind="stable")
    is_new = np.concatenate([[True], np.diff(stamps_s[order]) > 0.0])
    if (np.diff(stamps_s) < 0.0).any():
        warnings.append(f"{file.name} is not in the order of time; it was sorted")
    if not is_new.all():
        warnings.append(
            f"{file.name} has {int((~is_new).sum())} line(s) whose timestamp came before; the"
            " first of each was used"
        )
    kept: list[int] = order[is_new].tolist()
    return kept

# SPDX-License-Identifier: Apache-2.0
"""Lists as the TUM RGB-D benchmark has them: an image or a camera pose a line, its time first."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.errors import LoopcloseError
from placerec.files import read_text

FloatArray = NDArray[np.float64]
POSE_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_SEPARATOR = re.compile(r"[\s,]+")
_MIN_QUATERNION_NORM, _MAX_QUATERNION_NORM = 1e-6, 1e6
_LARGEST = 1e12  # of what a pose holds, in whatever unit
_NO_NUMBER = re.compile(r"^[-+]?(nan.*|1\.#.*|none|null|n/a)$", re.IGNORECASE)


def read_images(file: Path) -> tuple[FloatArray, list[Path]]:
    """Read lines of `timestamp filename`: (N,) seconds and N paths, in the order of the file.

    Raises:
        LoopcloseError: the file cannot be read, names no image, or a line is something else.
    """
    stamps_s: list[float] = []
    paths: list[Path] = []
    for number, line in read_lines(file):
        fields = _SEPARATOR.split(line, maxsplit=1)
        values = as_numbers(fields[0])
        if values is None or len(fields) != 2:
            raise LoopcloseError(f'line {number} is not "timestamp filename": {line!r}: {file}')
        stamps_s += values
        paths.append(file.parent / fields[1])
    if not paths:
        raise LoopcloseError(f"the list names no image: {file}")
    return np.array(stamps_s), paths


def read_poses(file: Path, *, with_gaps: bool = False) -> Iterator[tuple[int, list[float]]]:
    """Yield (line number, POSE_COLUMNS): seconds, metres and a quaternion not of length zero.

    With gaps, a pose that holds no number, or a quaternion of zeros, is one of NaN: so tools write
    that they did not see what they follow.

    Raises:
        LoopcloseError: the file cannot be read, or a line is something else.
    """
    for number, line in read_lines(file):
        pose = as_numbers(line)
        if with_gaps and (gap := _gap(line)):
            yield number, gap
            continue
        if pose is None or len(pose) != 8:
            raise LoopcloseError(
                f'line {number} is not "{POSE_COLUMNS}" in finite numbers: {line!r}: {file}'
            )
        length = math.hypot(*pose[4:])
        if not _MIN_QUATERNION_NORM <= length <= _MAX_QUATERNION_NORM:
            size = "zero" if length < 1.0 else f"{length:.3g}, not 1"
            raise LoopcloseError(
                f"line {number} has a quaternion of length {size}: {line!r}: {file}"
            )
        yield number, pose


def _gap(line: str) -> list[float] | None:
    """Return the row of a pose that is not known, None where the line is something else."""
    fields = [_NO_NUMBER.sub("nan", field) for field in line.replace(",", " ").split()]
    try:
        stamp_s, *values = (float(field) for field in fields)
    except ValueError:
        return None
    if len(values) != 7 or not np.isfinite(stamp_s):
        return None
    is_known = all(abs(value) < _LARGEST for value in values) and any(values[3:])
    return None if is_known else [stamp_s, *[np.nan] * 7]


def read_lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield (line number, text) of the lines that hold data: no comment, not empty.

    Raises:
        LoopcloseError: the file cannot be read or is not text.
    """
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def as_numbers(text: str) -> list[float] | None:
    """Return what blanks and commas separate as finite numbers, or None where one is none."""
    try:
        values = [float(field) for field in text.replace(",", " ").split()]
    except ValueError:
        return None
    return values if values and np.isfinite(values).all() else None


def as_whole_number(text: str) -> int | None:
    """Return a whole number of 64 bits from 0, or None where a text is none."""
    digits = text.strip()
    if not (digits.isascii() and digits.isdecimal()) or len(digits) > 100:
        return None
    return number if (number := int(digits)) < 1 << 63 else None


def nearest(stamps_s: FloatArray, wanted_s: FloatArray) -> NDArray[np.int64]:
    """Return, for each of (M,) times, the index of the nearest of (N,) increasing stamps, N > 0.

    The earlier of two stamps that are equally near wins.
    """
    after = np.searchsorted(stamps_s, wanted_s).clip(max=len(stamps_s) - 1)
    before = (after - 1).clip(min=0)
    is_after = np.abs(stamps_s[after] - wanted_s) < np.abs(wanted_s - stamps_s[before])
    return np.where(is_after, after, before)

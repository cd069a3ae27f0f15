# SPDX-License-Identifier: Apache-2.0
"""Lists as the TUM RGB-D benchmark has them: an image or a camera pose a line, its time first."""

import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.times import in_seconds
from placerec.errors import LoopcloseError
from placerec.files import is_file, read_text

FloatArray = NDArray[np.float64]
POSE_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_LARGEST = 1e12  # of what a pose holds, in whatever unit
_NO_NUMBER = re.compile(r"^[-+]?(nan.*|1\.#.*|none|null|n/a)$", re.IGNORECASE)
_MIN_QUATERNION_NORM, _MAX_QUATERNION_NORM = 1e-6, 1e6
_FIELD = re.compile(r'"([^"]*)"|\'([^\']*)\'|([^\s,;"\']+)')
_TIME = re.compile(r'["\']?([-+]?\d+,\d+(?=["\'\s;])|[-+.\d][^\s,;"\']*)["\']?[\s,;]+(?=\S)(.+)')
_WHOLE = re.compile(r"[-+]?\d+")
_DECIMAL_COMMA = r"([-+]?\d+(,\d+)?(e[-+]?\d+)?|[-+]?nan)"
_DECIMAL_COMMAS = re.compile(rf"{_DECIMAL_COMMA}((\s*;\s*|\s+){_DECIMAL_COMMA})+", re.IGNORECASE)
_MARK = "\ufeff"  # in the middle of a file where two were joined


def read_images(file: Path, warnings: list[str]) -> tuple[FloatArray, list[Path]]:
    """Read lines of `timestamp filename`: (N,) seconds and N paths, in the order of the file.

    What other tools write is read too: names in quotes, with backslashes, or with more behind them;
    a header; decimal commas; and times in another unit, which the warnings then name.

    Raises:
        LoopcloseError: the file cannot be read, names no image, or a line is something else.
    """
    stamp_of: dict[tuple[str, str], float] = {}
    again = 0
    for number, line in without_header(read_lines(file)):
        match = _TIME.fullmatch(line)
        stamp = as_numbers(match[1].replace(",", ".")) if match else None
        if match is None or stamp is None:
            raise LoopcloseError(f'line {number} is not "timestamp filename": {line!r}: {file}')
        again += match.groups() in stamp_of
        stamp_of[match[1], match[2]] = stamp[0]
    if not stamp_of:
        raise LoopcloseError(f"the list names no image: {file}")
    if again:
        warnings.append(f"{file.name} has {again} line(s) that came before; each was used once")
    stamps = np.array(list(stamp_of.values()))
    are_whole = all(is_whole(stamp) for stamp, _ in stamp_of)
    stamps_s = in_seconds(stamps, file, warnings, are_whole=are_whole)
    return stamps_s, [named_file(file.parent, name) for _, name in stamp_of]


def is_whole(stamp: str) -> bool:
    """Return whether a time is written without a point, as numbers of images are."""
    return _WHOLE.fullmatch(stamp) is not None


def named_file(folder: Path, name: str) -> Path:
    """Return the file that a list names: as it is, or without what other tools put around it."""
    first = split_fields(name)[:1]
    candidates = [folder / each for given in (name, *first) for each in (given, slashed(given))]
    return next((path for path in candidates if is_file(path)), candidates[1])


def slashed(name: str) -> str:
    """Return a path as it is written where folders are parted by slashes."""
    return name.replace("\\", "/")


def split_fields(line: str) -> list[str]:
    """Return what blanks, commas and semicolons separate; in quotes they do not."""
    return [next(filter(None, match.groups()), "") for match in _FIELD.finditer(line)]


def without_header(lines: Iterable[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield numbered lines, but for a first one that names the columns."""
    for i, (number, line) in enumerate(lines):
        is_header = line[0].isalpha() and not any(character.isdigit() for character in line)
        if i or not is_header or line.lower().startswith(("nan", "inf")):
            yield number, line


def read_poses(file: Path, *, with_gaps: bool = False) -> Iterator[tuple[int, list[float]]]:
    """Yield (line number, POSE_COLUMNS): seconds, metres and a quaternion not of length zero.

    With gaps, a pose that holds no number, or a quaternion of zeros, is one of NaN: so tools write
    that they did not see what they follow.

    Raises:
        LoopcloseError: the file cannot be read, or a line is something else.
    """
    for number, line in without_header(read_lines(file)):
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
    fields = [_NO_NUMBER.sub("nan", field) for field in _number_fields(line)]
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
        stripped = line.strip().lstrip(_MARK)
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def as_numbers(text: str) -> list[float] | None:
    """Return what blanks, commas and semicolons separate as finite numbers, else None.

    Where blanks or semicolons do, a comma between digits is a decimal one, as in `1,5 2,25`.
    """
    try:
        values = [float(field) for field in _number_fields(text)]
    except ValueError:
        return None
    return values if values and np.isfinite(values).all() else None


def as_number(text: str) -> float | None:
    """Return a field that is one finite number, else None."""
    numbers = as_numbers(text)
    return numbers[0] if numbers is not None and len(numbers) == 1 else None


def _number_fields(text: str) -> list[str]:
    if "," in text and "." not in text and _DECIMAL_COMMAS.fullmatch(text.strip()):
        text = text.replace(",", ".")
    return re.split(r"[\s,;]+", text.strip(" \t,;"))


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

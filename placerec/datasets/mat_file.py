# SPDX-License-Identifier: Apache-2.0
"""One matrix of numbers from a MATLAB file (version 5 to 7), whatever else the file claims to be.

"MAT-File Format", The MathWorks, 2024, chapter 1. SciPy's reader, in C, crashes on damaged files.
"""

import struct
import zlib
from collections.abc import Iterator
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.files import MOST_BYTES

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"} | {
    12: "i8",
    13: "u8",
}
_NUMERIC_CLASSES = range(6, 16)
_FLAGS, _DIMENSIONS, _NAME, _REAL = range(4)


def read_mat(content: bytes, name: str) -> NDArray[Any] | None:
    """Return the array of real numbers that a name stands for, None where there is none.

    Raises:
        ValueError: this is no MATLAB file of version 5 to 7, or it is damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[_HEADER_BYTES - 2 : _HEADER_BYTES])
    if order is None:
        raise ValueError("not a MATLAB file of version 5 to 7")
    try:
        for kind, element in _elements(content[_HEADER_BYTES:], order):
            if kind == _COMPRESSED:
                inner = zlib.decompressobj().decompress(element, MOST_BYTES)
                kind, element = next(_elements(inner, order), (0, b""))
            if kind == _MATRIX and (array := _array(element, name, order)) is not None:
                return array
    except (struct.error, zlib.error, LookupError) as error:
        raise ValueError("the file is cut off or damaged") from error
    return None


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield the (type, content) of data elements that follow each other."""
    at = 0
    while at < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        start = at + 8
        if small := kind >> 16:
            kind, size, start = kind & 0xFFFF, small, at + 4
        if start + size > len(content):
            raise ValueError("the file is cut off")
        yield kind, content[start : start + size]
        at = start + size if kind == _COMPRESSED else (start + size + 7) // 8 * 8


def _array(element: bytes, name: str, order: str) -> NDArray[Any] | None:
    parts = []
    for part in _elements(element, order):
        parts.append(part)
        if len(parts) > _REAL:
            break
    if parts[_NAME][1] != name.encode():
        return None
    (flags,) = struct.unpack_from(f"{order}I", parts[_FLAGS][1])
    if flags & 0xFF not in _NUMERIC_CLASSES:
        return None
    shape = np.frombuffer(parts[_DIMENSIONS][1], f"{order}i4").tolist()
    kind, numbers = parts[_REAL]
    values = np.frombuffer(numbers, f"{order}{_NUMBERS[kind]}")
    if min(shape) < 0 or prod(shape) != len(values):
        raise ValueError("the matrix is not of the size that it says")
    return values.reshape(shape, order="F")

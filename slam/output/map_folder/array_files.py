# SPDX-License-Identifier: Apache-2.0
"""Arrays as .npy files: written piece by piece, and mapped into memory, not read."""

import io
import os
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

_CHUNK_BYTES = 1 << 20


def write_file(path: Path, parts: Iterable[bytes]) -> dict[str, int]:
    """Write a file to the disk itself, and return its size in bytes and its CRC-32.

    Raises:
        OSError: it cannot be written.
    """
    size, crc = 0, 0
    with path.open("wb") as stream:
        for part in parts:
            stream.write(part)
            size, crc = size + len(part), zlib.crc32(part, crc)
        stream.flush()
        os.fsync(stream.fileno())
    return {"bytes": size, "crc32": crc}


def measure_file(path: Path) -> dict[str, int]:
    """Return the size and CRC-32 of a file, as `write_file` does.

    Raises:
        OSError: it cannot be read.
    """
    size, crc = 0, 0
    with path.open("rb", buffering=0) as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            size, crc = size + len(chunk), zlib.crc32(chunk, crc)
    return {"bytes": size, "crc32": crc}


def npy_parts(length: int, parts: Iterable[NDArray[Any]]) -> Iterable[bytes]:
    """Yield the content of a .npy file of one or more arrays, `length` rows in all."""
    for number, part in enumerate(parts):
        if number == 0:
            told = {
                "descr": npy.dtype_to_descr(part.dtype),
                "fortran_order": False,
                "shape": (length, *part.shape[1:]),
            }
            head = io.BytesIO()
            npy.write_array_header_1_0(head, told)
            yield head.getvalue()
        yield np.ascontiguousarray(part).tobytes()


def mapped_array(path: Path) -> NDArray[Any]:
    """Return the array of a .npy file, read from there as it is needed; changes stay in memory.

    Raises:
        OSError, ValueError: it cannot be read, or holds no array of numbers.
    """
    # What loops are compiled for is a plain array that may be written to.
    return np.asarray(np.load(path, mmap_mode="c", allow_pickle=False)).view(np.ndarray)

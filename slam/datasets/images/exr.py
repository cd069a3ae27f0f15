# SPDX-License-Identifier: Apache-2.0
"""OpenEXR images of one number per pixel: the plain kinds, which OpenCV may be built without.

https://openexr.com/en/latest/OpenEXRFileLayout.html; scan lines, not compressed or by ZIP.
"""

import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.image_size import MOST_PIXELS
from placerec.datasets.images import BrokenImage, content_of
from slam.types import SlamError

EXR_MAGIC = b"\x76\x2f\x31\x01"
_TILES_OR_PARTS = 0x200 | 0x800 | 0x1000
_PIXEL_TYPES: dict[int, np.dtype[Any]] = {
    0: np.dtype("<u4"),
    1: np.dtype("<f2"),
    2: np.dtype("<f4"),
}
_LINES_PER_CHUNK = {0: 1, 2: 1, 3: 16}
_COMPRESSIONS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
_DEPTH_CHANNELS = ("R", "Z", "Y")


class _Channel(NamedTuple):
    name: str
    kind: np.dtype[Any]


def read_exr(path: Path) -> NDArray[np.float32] | BrokenImage:
    """Return the only channel of an image, or that of R, Z or Y, as (H, W) float32.

    Raises:
        SlamError: the image is of a kind that is not read here.
    """
    content = content_of(path)
    return content if isinstance(content, BrokenImage) else decode_exr(content, path)


def decode_exr(content: bytes, path: Path) -> NDArray[np.float32] | BrokenImage:
    """Return what `read_exr` does of a file, named `path`, with this content.

    Raises:
        SlamError: the image is of a kind that is not read here.
    """
    if content and not content.startswith(EXR_MAGIC):
        return BrokenImage(path, "not an OpenEXR image")
    try:
        return _decoded(content, path)
    except (struct.error, ValueError, LookupError, OverflowError, zlib.error):
        return BrokenImage(path, "the file is cut off or damaged")


def _decoded(content: bytes, path: Path) -> NDArray[np.float32]:
    if struct.unpack_from("<i", content, 4)[0] & _TILES_OR_PARTS:
        raise SlamError(f"an OpenEXR image of tiles or of several parts is not read here: {path}")
    header, at = _read_header(content)
    channels = _read_channels(header["channels"])
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if min(width, height) < 1 or width * height * len(channels) > MOST_PIXELS:
        raise ValueError("no such size")
    compression = header["compression"][0]
    if compression not in _LINES_PER_CHUNK:
        raise SlamError(
            f"an OpenEXR image is compressed by {_COMPRESSIONS[compression]}, only ZIP, ZIPS and"
            f" none are read here; write it anew as one of these: {path}"
        )
    step = _LINES_PER_CHUNK[compression]
    row_bytes = width * sum(channel.kind.itemsize for channel in channels)
    rows = np.zeros((height, row_bytes), np.uint8)
    for offset in np.frombuffer(content, "<u8", -(-height // step), at).tolist():
        line, size = struct.unpack_from("<ii", content, offset)
        if not top <= line <= bottom:
            raise ValueError("no such line")
        chunk = rows[line - top : line - top + step]
        stored = np.frombuffer(content, np.uint8, size, offset + 8)
        chunk[:] = (stored if size == chunk.size else _inflated(stored, chunk.size)).reshape(
            chunk.shape
        )
    start, kind = _find_depth(channels, width, path)
    own = np.ascontiguousarray(rows[:, start : start + width * kind.itemsize])
    return own.view(kind).astype(np.float32)


def _read_header(content: bytes) -> tuple[dict[str, bytes], int]:
    """Return the values of the header by name, and where it ends."""
    header, at = {}, 8
    while content[at]:
        name_end = content.index(b"\0", at)
        type_end = content.index(b"\0", name_end + 1)
        (size,) = struct.unpack_from("<i", content, type_end + 1)
        if size < 0:  # the search would go round for ever
            raise ValueError("no such size")
        value = type_end + 5
        header[content[at:name_end].decode()] = content[value : value + size]
        at = value + size
    return header, at + 1


def _read_channels(value: bytes) -> list[_Channel]:
    channels, at = [], 0
    while value[at]:
        end = value.index(b"\0", at)
        (kind,) = struct.unpack_from("<i", value, end + 1)
        channels.append(_Channel(value[at:end].decode(), _PIXEL_TYPES[kind]))
        at = end + 17
    return channels


def _find_depth(channels: list[_Channel], width: int, path: Path) -> tuple[int, np.dtype[Any]]:
    """Return at which byte of a row the numbers begin, and their type."""
    names = [channel.name for channel in channels]
    wanted = names if len(names) == 1 else [name for name in _DEPTH_CHANNELS if name in names]
    if not wanted:
        raise SlamError(
            f"an OpenEXR image has the channels {', '.join(names)}; depth is looked for in a single"
            f" one, or in {', '.join(_DEPTH_CHANNELS)}: {path}"
        )
    i = names.index(wanted[0])
    return width * sum(channel.kind.itemsize for channel in channels[:i]), channels[i].kind


def _inflated(stored: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Return the bytes that ZIP made small: differences of bytes, those of even places first."""
    unpacked = zlib.decompressobj().decompress(stored.tobytes(), size)
    differences = np.frombuffer(unpacked, np.uint8).astype(np.int64)
    differences[1:] -= 128
    values = np.cumsum(differences).astype(np.uint8)
    half = (len(values) + 1) // 2
    mixed = np.empty_like(values)
    mixed[0::2], mixed[1::2] = values[:half], values[half:]
    return mixed

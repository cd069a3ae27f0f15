# SPDX-License-Identifier: Apache-2.0
"""How large an image file says it is, before anything of it is decoded.

A few bytes can claim any size, and decoders make room for all of it.
"""

import re
import struct
from collections.abc import Callable

MOST_PIXELS = 1 << 26
"""Of an image that is decoded; a camera of 64 megapixels just fits."""
_MOST_SCANS = 200
"""Of a JPEG; each goes over all pixels. Encoders make a dozen."""

_PNG = b"\x89PNG\r\n\x1a\n"
_UNREADABLE = "not a readable image"
_NUMBER_IN_PNM = re.compile(rb"(?:\s|#[^\n]*\n)*(\d{1,9})")
_STARTS_OF_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
_TIFF_SIZES = {256: 0, 257: 1, 322: 0, 323: 1}  # width, height, and those of a tile
_TIFF_NUMBERS = {3: "H", 4: "I", 16: "Q"}


def image_size(content: bytes) -> tuple[int, int]:
    """Return the (width, height) of an image, pixels, as its header has it.

    Raises:
        ValueError: this is no image of a kind that is read: PNG, JPEG, BMP, TIFF, PNM or WebP.
    """
    reader = next((read for start, read in _READERS.items() if content.startswith(start)), None)
    if reader is None:
        raise ValueError(_UNREADABLE)
    try:
        return reader(content)
    except (struct.error, LookupError, OverflowError, ValueError) as error:
        raise ValueError(_UNREADABLE) from error


def check_size(width: int, height: int) -> None:
    """Refuse an image, or a camera, of more pixels than are decoded.

    Raises:
        ValueError: it has more.
    """
    if width * height > MOST_PIXELS:
        raise ValueError(
            f"an image of {width}x{height} pixels, more than {MOST_PIXELS / 1e6:.0f} million"
        )


def _png(content: bytes) -> tuple[int, int]:
    sizes = []
    at = len(_PNG)
    while at < len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        if at + length > len(content):  # the decoder would make room for all of it
            raise ValueError
        if kind == b"IHDR":
            sizes.append(struct.unpack_from(">II", content, at + 8))
        elif kind == b"fcTL":  # of an animation
            sizes.append(struct.unpack_from(">II", content, at + 12))
        elif kind == b"IEND":
            break
        at += length + 12
    return max(width for width, _ in sizes), max(height for _, height in sizes)


def _jpeg(content: bytes) -> tuple[int, int]:
    if content.count(b"\xff\xda") > _MOST_SCANS:  # which would take hours
        raise ValueError
    at = 2
    while True:
        at = content.index(b"\xff", at)
        while content[at] == 0xFF:
            at += 1
        marker = content[at]
        if marker in _STARTS_OF_FRAMES:
            height, width = struct.unpack_from(">HH", content, at + 4)
            return width, height
        if marker not in _WITHOUT_LENGTH:
            at += struct.unpack_from(">H", content, at + 1)[0]


def _bmp(content: bytes) -> tuple[int, int]:
    if content[14] == 12:  # of OS/2
        width, height = struct.unpack_from("<HH", content, 18)
        return width, height
    width, height = struct.unpack_from("<ii", content, 18)
    return abs(width), abs(height)


def _tiff(content: bytes) -> tuple[int, int]:
    order = "<" if content.startswith(b"II") else ">"
    is_big = struct.unpack_from(f"{order}H", content, 2)[0] == 43
    start, count, entry, value = ("8Q", "Q", 20, 12) if is_big else ("4I", "H", 12, 8)
    (at,) = struct.unpack_from(f"{order}{start[1]}", content, int(start[0]))
    (entries,) = struct.unpack_from(f"{order}{count}", content, at)
    at += struct.calcsize(count)
    size = [0, 0]
    for i in range(min(entries, 4096)):
        tag, kind = struct.unpack_from(f"{order}HH", content, at + i * entry)
        if tag in _TIFF_SIZES and kind in _TIFF_NUMBERS:
            form, place = f"{order}{_TIFF_NUMBERS[kind]}", at + i * entry + value
            side = _TIFF_SIZES[tag]
            size[side] = max(size[side], struct.unpack_from(form, content, place)[0])
    return size[0], size[1]


def _pnm(content: bytes) -> tuple[int, int]:
    width = _NUMBER_IN_PNM.match(content, 2)
    height = _NUMBER_IN_PNM.match(content, width.end()) if width else None
    if not width or not height:
        raise ValueError
    return int(width[1]), int(height[1])


def _webp(content: bytes) -> tuple[int, int]:
    kind = content[12:16]
    if content[8:12] != b"WEBP" or kind not in {b"VP8 ", b"VP8L", b"VP8X"}:
        raise ValueError
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", content, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    sides = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (24, 27))
    width, height = sides
    return width, height


_READERS: dict[bytes, Callable[[bytes], tuple[int, int]]] = {
    _PNG: _png,
    b"\xff\xd8\xff": _jpeg,
    b"BM": _bmp,
    b"RIFF": _webp,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), _tiff),
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6", b"Pf", b"PF"), _pnm),
}

# SPDX-License-Identifier: Apache-2.0
"""Photographs on disk, decoded; a broken file is an answer, not an exception."""

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike
from kornia_rs.io import decode_image_png_u16
from numpy.typing import NDArray

from placerec.datasets.image_size import check_size, image_size
from placerec.errors import LoopcloseError
from placerec.files import read_bytes

_IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".ppm", ".bmp", ".tif", ".tiff", ".webp"})
_NUMBERS = re.compile(r"([^0-9]*)(?:([0-9]+)(?:\.([0-9]+))?|$)")
_TAIL_BYTES = 64
_ENDINGS = ((b"\x89PNG\r\n\x1a\n", b"IEND"), (b"\xff\xd8\xff", b"\xff\xd9"))
_ONE_CHANNEL_OF_16_BITS = re.compile(rb"\x89PNG\r\n\x1a\n.{4}IHDR.{8}\x10\0", re.DOTALL)


class BrokenImage(NamedTuple):
    """An image file that cannot be used, and why."""

    path: Path
    why: str


def read_image(path: Path) -> NDArray[np.uint8] | BrokenImage:
    """Return an image as (H, W, 3) uint8 RGB; grey gets three equal channels, alpha is dropped."""
    image = decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if isinstance(image, BrokenImage):
        return image
    if image.dtype not in (np.uint8, np.uint16):
        return BrokenImage(path, f"colours of {image.dtype}, not of 8 or 16 bits")
    image = in_eight_bits(image, used_bits([image]))
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), dtype=np.uint8)


_BITS = (8, 10, 12, 14, 16)  # that cameras count light in


def used_bits(images: Iterable[MatLike]) -> int:
    """Return in how many bits images count light, 8 to 16: sensors of 12 fill no more of 16."""
    brightest = max((int(image.max()) for image in images if image.dtype == np.uint16), default=0)
    return next(bits for bits in _BITS if brightest < 1 << bits)


def in_eight_bits(image: MatLike, bits: int) -> MatLike:
    """Return an image of 8 bits as it is, one that uses so many of 16 in the upper 8 of these."""
    if image.dtype == np.uint8:
        return image
    return (np.minimum(image, (1 << bits) - 1) >> (bits - 8)).astype(np.uint8)


def find_fault(path: Path) -> BrokenImage | None:
    """Return what is wrong with an image file, None where it can be read."""
    # Looks at all of the file, but is done in half the time of a full decoding.
    image = decode(path, cv2.IMREAD_REDUCED_GRAYSCALE_8)
    if isinstance(image, BrokenImage):  # or of less than 8 pixels, of which nothing would be left
        image = decode(path, cv2.IMREAD_COLOR)
    return image if isinstance(image, BrokenImage) else None


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder, hidden ones apart, in the order that people count in."""
    files = (file for file in folder.iterdir() if file.suffix.lower() in _IMAGE_SUFFIXES)
    return sorted(
        (file for file in files if not file.name.startswith(".") and file.is_file()),
        key=lambda file: natural_order(file.name),
    )


def natural_order(name: str) -> list[tuple[str, int, str]]:
    """Return what sorts names by the numbers in them: 2 before 10, and 1.25 before 1.5."""
    parts = _NUMBERS.findall(name)
    return [(text, int(whole or -1), decimals) for text, whole, decimals in parts] + [(name, 0, "")]


def decode(path: Path, flags: int) -> MatLike | BrokenImage:
    """Return an image as `cv2.imdecode` makes it with these flags."""
    content = content_of(path)
    return content if isinstance(content, BrokenImage) else decode_content(content, path, flags)


def content_of(path: Path) -> bytes | BrokenImage:
    """Return what an image file, or one of depth in another form, holds."""
    try:
        return read_bytes(path)
    except LoopcloseError as error:
        why = str(error).removeprefix(f"cannot read {path.name}: ").removesuffix(f": {path}")
        return BrokenImage(path, why)


def decode_content(content: bytes, path: Path, flags: int) -> MatLike | BrokenImage:
    """Return the image that an image file, named `path`, with this content would hold."""
    if _is_cut_off(content):
        return BrokenImage(path, "the file is cut off")
    try:
        check_size(*image_size(content))
    except ValueError as error:
        return BrokenImage(path, str(error))
    image = _decoded(content, flags)
    return BrokenImage(path, "not a readable image") if image is None else image


def _decoded(content: bytes, flags: int) -> MatLike | None:
    if flags == cv2.IMREAD_UNCHANGED and _ONE_CHANNEL_OF_16_BITS.match(content):
        width, height = image_size(content)
        with suppress(Exception):  # is all that it raises; then OpenCV, which takes twice as long
            return np.asarray(decode_image_png_u16(content, (height, width), "mono"))[..., 0]
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None


def _is_cut_off(content: bytes) -> bool:
    # Decoders fill what is missing with grey and report success.
    tail = content.rstrip(b"\0")[-_TAIL_BYTES:]
    for start, end in _ENDINGS:
        if content.startswith(start):
            return end not in tail
    return not tail

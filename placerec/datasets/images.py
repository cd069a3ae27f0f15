# SPDX-License-Identifier: Apache-2.0
"""Photographs on disk, decoded; a broken file is an answer, not an exception."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from placerec.datasets.image_size import check_size, image_size
from placerec.errors import LoopcloseError
from placerec.files import read_bytes

_IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".ppm", ".bmp", ".tif", ".tiff", ".webp"})
_TAIL_BYTES = 64
_ENDINGS = ((b"\x89PNG\r\n\x1a\n", b"IEND"), (b"\xff\xd8\xff", b"\xff\xd9"))


class BrokenImage(NamedTuple):
    """An image file that cannot be used, and why."""

    path: Path
    why: str


def read_image(path: Path) -> NDArray[np.uint8] | BrokenImage:
    """Return an image as (H, W, 3) uint8 RGB; grey gets three equal channels, alpha is dropped."""
    image = decode(path, cv2.IMREAD_COLOR)
    if isinstance(image, BrokenImage):
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), dtype=np.uint8)


def find_fault(path: Path) -> BrokenImage | None:
    """Return what is wrong with an image file, None where it can be read."""
    # Looks at all of the file, but is done in half the time of a full decoding.
    image = decode(path, cv2.IMREAD_REDUCED_GRAYSCALE_8)
    if isinstance(image, BrokenImage):  # or of less than 8 pixels, of which nothing would be left
        image = decode(path, cv2.IMREAD_COLOR)
    return image if isinstance(image, BrokenImage) else None


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder, by name; numbers of equal length sort as numbers do."""
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _IMAGE_SUFFIXES)


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
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        image = None
    return BrokenImage(path, "not a readable image") if image is None else image


def _is_cut_off(content: bytes) -> bool:
    # Decoders fill what is missing with grey and report success.
    tail = content.rstrip(b"\0")[-_TAIL_BYTES:]
    for start, end in _ENDINGS:
        if content.startswith(start):
            return end not in tail
    return not tail

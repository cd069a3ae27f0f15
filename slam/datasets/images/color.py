# SPDX-License-Identifier: Apache-2.0
"""Colour image files, decoded; a broken file is an answer, not an exception."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage, decode, in_eight_bits, used_bits

# Turning an image as its EXIF data asks would tear it away from its depth image.
COLOR_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def read_color(path: Path, bits: int = 16) -> NDArray[np.uint8] | BrokenImage:
    """Return a colour image as (H, W, 3) uint8 RGB; grey images get three equal channels.

    Of images of 16 bits so many are used, the uppermost 8 of which are returned.
    """
    image = decode(path, COLOR_FLAGS | cv2.IMREAD_ANYDEPTH)
    if isinstance(image, BrokenImage):
        return image
    if image.dtype not in (np.uint8, np.uint16):
        return BrokenImage(path, f"colours of {image.dtype}, not of 8 or 16 bits")
    image = in_eight_bits(image, bits)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), dtype=np.uint8)


def color_bits(paths: Sequence[Path]) -> int:
    """Return how many bits the colour images of a recording use; 8 where they have no more."""
    images = (decode(path, COLOR_FLAGS | cv2.IMREAD_ANYDEPTH) for path in paths)
    readable = (image for image in images if not isinstance(image, BrokenImage))
    first = next(readable, None)
    return 8 if first is None or first.dtype != np.uint16 else used_bits([first, *readable])

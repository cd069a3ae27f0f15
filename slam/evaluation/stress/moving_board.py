# SPDX-License-Identifier: Apache-2.0
"""A board of random colours that moves across the images, near to the camera."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.types import Frame

NEAR_M = 0.7
"""How far before the camera it is."""

_COLOUR_PX = 10


def board(width: int, height: int) -> NDArray[np.uint8]:
    """Return its (height, width, 3) image, always the same; there is none without an extent."""
    rows, columns = height // _COLOUR_PX, width // _COLOUR_PX
    if not rows or not columns:
        return np.zeros((0, 0, 3), np.uint8)
    colours = np.random.default_rng(0).integers(0, 255, (rows, columns, 3), dtype=np.uint8)
    row, column = np.arange(height) * rows // height, np.arange(width) * columns // width
    return colours[row[:, None], column]


def covered(frame: Frame, image: NDArray[np.uint8], moved_px: int) -> Frame:
    """Return a frame before which a board is, halfway up, so many pixels from its first place.

    Where it reaches the right edge it begins again at the left one. Its depth is there with it.
    """
    height, width = image.shape[:2]
    if not image.size:
        return frame
    rgb, depth_m = frame.rgb.copy(), frame.depth_m.copy()
    left = moved_px % max(1, rgb.shape[1] - width)
    top = (rgb.shape[0] - height) // 2
    here = slice(top, top + height), slice(left, left + width)
    rgb[here], depth_m[here] = image, NEAR_M
    return replace(frame, rgb=rgb, depth_m=depth_m)

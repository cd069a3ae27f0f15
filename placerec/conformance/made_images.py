# SPDX-License-Identifier: Apache-2.0
"""Generated pictures of places, and of nothing that could be one."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

PLACES = 6
_HEIGHT_PX, _WIDTH_PX = 480, 640
SHIFT_PX = 16
GAINS = (0.8, 1.25)
_SQUARE_PX = 80
_RING_PX = 19


def places(shift_px: int = 0) -> list[Image]:
    """Return a (480, 640, 3) picture of each place, the camera turned right by some pixels."""
    window = np.s_[:, shift_px : shift_px + _WIDTH_PX]
    return [np.ascontiguousarray(_wall(seed)[window]) for seed in range(PLACES)]


def relit(gain: float) -> list[Image]:
    """Return the places as a shorter or longer exposure shows them; what is too bright is white."""
    return [np.clip(image * gain, 0, 255).astype(np.uint8) for image in places()]


def halved() -> list[Image]:
    """Return the places at half their size: every 2 x 2 pixels are one, their mean."""
    return [_mean_of_four(image) for image in places()]


def unlike() -> list[Image]:
    """Return (480, 640, 3) pictures that have nothing in common with each other or a place."""
    rng = np.random.default_rng(PLACES)
    rows, columns = np.mgrid[:_HEIGHT_PX, :_WIDTH_PX]
    distance = np.hypot(rows - _HEIGHT_PX / 2, columns - _WIDTH_PX / 2)
    grey = [
        np.zeros((_HEIGHT_PX, _WIDTH_PX)),
        255 * columns / (_WIDTH_PX - 1),
        255.0 * (rows % 40 < 2),
        255.0 * (distance // _RING_PX % 2),
    ]
    noise = rng.integers(0, 256, (_HEIGHT_PX, _WIDTH_PX, 3), np.uint8)
    few = rng.integers(0, 256, (_HEIGHT_PX // _SQUARE_PX, _WIDTH_PX // _SQUARE_PX, 3), np.uint8)
    squares = few.repeat(_SQUARE_PX, axis=0).repeat(_SQUARE_PX, axis=1)
    return [noise, squares, *(each.astype(np.uint8)[..., None].repeat(3, axis=2) for each in grey)]


def _mean_of_four(image: Image) -> Image:
    height, width, channels = image.shape
    cells = image.reshape(height // 2, 2, width // 2, 2, channels)
    return np.asarray(cells.mean(axis=(1, 3)), np.uint8)


@cache
def _wall(seed: int) -> Image:
    """Return a picture of a wall hung with plain and striped boards, wider than one view."""
    rng = np.random.default_rng(seed)
    image = np.full((_HEIGHT_PX, _WIDTH_PX + SHIFT_PX, 3), rng.integers(60, 200, 3), np.uint8)
    for _ in range(40):
        top, left = rng.integers(0, _HEIGHT_PX - 40), rng.integers(0, _WIDTH_PX - 40)
        board = image[top : top + rng.integers(20, 160), left : left + rng.integers(20, 160)]
        board[:] = rng.integers(0, 256, 3)
        stripe = int(rng.integers(4, 20))
        board[:, :: 2 * stripe] = rng.integers(0, 256, 3)
        board[:: 3 * stripe] = rng.integers(0, 256, 3)
    return image

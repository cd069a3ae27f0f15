# SPDX-License-Identifier: Apache-2.0
"""Generated pictures of places."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

PLACES = 6
_HEIGHT_PX, _WIDTH_PX = 480, 640
SHIFT_PX = 16


def places(shift_px: int = 0) -> list[Image]:
    """Return a (480, 640, 3) picture of each place, the camera turned right by some pixels."""
    window = np.s_[:, shift_px : shift_px + _WIDTH_PX]
    return [np.ascontiguousarray(_wall(seed)[window]) for seed in range(PLACES)]


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

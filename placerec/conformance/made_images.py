# SPDX-License-Identifier: Apache-2.0
"""Generated pictures of places, and the same places seen a little differently."""

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


def relit(images: list[Image], gain: float) -> list[Image]:
    """Return images as a longer or shorter exposure shows them; what is too bright is white."""
    return [np.clip(image * gain, 0, 255).astype(np.uint8) for image in images]


def colourless() -> list[Image]:
    """Return (480, 640, 3) images with little or nothing in them: grey, black, white, one hue."""
    grey = places()[0].mean(axis=2, keepdims=True).astype(np.uint8).repeat(3, axis=2)
    plain = [np.full_like(grey, colour) for colour in (0, 255, (200, 40, 90))]
    return [grey, *plain]


def odd_sizes() -> list[Image]:
    """Return a picture cut to sizes that no camera has, and one larger than most have."""
    wall = places()[0]
    cut = [wall[:241, :319], wall[:97, :641], wall[:480, :161], wall.repeat(2, 0).repeat(2, 1)]
    return [np.ascontiguousarray(image) for image in cut]


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

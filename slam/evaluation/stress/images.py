# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with the images of a recording, frame by frame.

Each function takes a frame, its number, how much is wrong, and a generator that is the frame's own:
what happens to one does not depend on the others, and a higher level does more of the same.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.stress.moving_board import board, covered
from slam.types import Frame

_PATCH = 40  # to the width of an image, so that what has no depth is patches, as of real sensors
_READ_NOISE = 1.5  # grey levels, standard deviation, of a sensor in the dark
_BOARD_STEP = 1.0 / 64.0  # of the width, from frame to frame

FrameStress = Callable[[Frame, int, float, np.random.Generator], Frame | None]


def drop(frame: Frame, number: int, share: float, rng: np.random.Generator) -> Frame | None:
    """Return the frame, or None for such a share of all."""
    return None if rng.uniform() < share else frame


def lose_depth(frame: Frame, number: int, share: float, rng: np.random.Generator) -> Frame:
    """Return it without depth in such a share of the image, in square patches."""
    height, width = frame.depth_m.shape
    size = max(1, width // _PATCH)
    is_lost = rng.uniform(size=(-(-height // size), -(-width // size))) < share
    row, column = np.arange(height) // size, np.arange(width) // size
    depth_m = np.where(is_lost[row[:, None], column], np.float32(0.0), frame.depth_m)
    return replace(frame, depth_m=depth_m)


def smear(frame: Frame, number: int, share: float, rng: np.random.Generator) -> Frame:
    """Return it smeared over such a share of its width, in a direction of its own."""
    steps = max(1, round(share * frame.rgb.shape[1]))
    angle = rng.uniform(0.0, np.pi)
    along = np.arange(steps) - (steps - 1) / 2.0
    margin = steps // 2 + 1
    padded = np.pad(frame.rgb, ((margin, margin), (margin, margin), (0, 0)), mode="edge")
    height, width = frame.depth_m.shape
    total = np.zeros(frame.rgb.shape, np.uint32)
    for x, y in zip(np.cos(angle) * along, np.sin(angle) * along, strict=True):
        top, left = margin + round(float(y)), margin + round(float(x))
        total += padded[top : top + height, left : left + width]
    return replace(frame, rgb=_rounded(total / steps))


def darken(frame: Frame, number: int, share: float, rng: np.random.Generator) -> Frame:
    """Return it with such a share of the light missing, and the noise that a sensor has."""
    noise = rng.normal(0.0, _READ_NOISE, frame.rgb.shape) if share else 0.0
    return replace(frame, rgb=_rounded((1.0 - share) * frame.rgb + noise))


def put_board(frame: Frame, number: int, share: float, rng: np.random.Generator) -> Frame:
    """Return it with a board moving before the camera that covers such a share of the image."""
    height, width = frame.depth_m.shape
    side = np.sqrt(share)
    image = board(round(side * width), round(side * height))
    return covered(frame, image, number * round(_BOARD_STEP * width))


def _rounded(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


IMAGE_STRESS: Mapping[str, FrameStress] = {
    "dropped-frames": drop,
    "missing-depth": lose_depth,
    "blur": smear,
    "darkness": darken,
    "moving-object": put_board,
}
"""By the name of what is wrong."""

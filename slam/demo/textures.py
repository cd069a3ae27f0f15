# SPDX-License-Identifier: Apache-2.0
"""What surfaces are made of: paint, brick, wood, cloth, all drawn at so many texels per metre.

A material is a function of a random generator and a size in metres. None repeats exactly: a place
that looked like another place would be a wrong loop waiting to happen.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Image = NDArray[np.uint8]
FloatImage = NDArray[np.float32]
Colour = tuple[float, float, float]
Material = Callable[[Generator, float, float], Image]

TEXELS_PER_M = 320


def size_px(width_m: float, height_m: float) -> tuple[int, int]:
    """Return (width, height) of the texture of a surface, at least 4 texels each."""
    return max(4, round(width_m * TEXELS_PER_M)), max(4, round(height_m * TEXELS_PER_M))


def to_image(values: NDArray[Any]) -> Image:
    """Return any real (H, W, 3) array as uint8, clipped to 0..255."""
    return np.asarray(np.clip(values, 0, 255), np.uint8)


def noise(
    rng: Generator, size: tuple[int, int], cell: tuple[int, int], octaves: int = 3
) -> FloatImage:
    """Return (H, W) float32 smooth random values of about zero mean and unit spread.

    `size` and `cell` are (width, height) in texels; each octave halves the cell and the amplitude.
    """
    width, height = size
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        cells = [max(2, c >> octave) for c in cell]
        grid = rng.standard_normal((height // cells[1] + 3, width // cells[0] + 3), np.float32)
        # The grid is stretched over whole cells, then cut, so that cells are equally large.
        full = (grid.shape[1] * cells[0], grid.shape[0] * cells[1])
        smooth = cv2.resize(grid, full, interpolation=cv2.INTER_CUBIC)
        total += smooth[:height, :width] * 0.5**octave
    return total


def _tint(values: FloatImage, colour: Colour, contrast: float) -> FloatImage:
    """Return (H, W, 3) float32: the colour, brighter and darker by `contrast` where values say."""
    return np.asarray(colour, np.float32) * (1.0 + contrast * values[..., None])


def colour_of(rng: Generator, low: float, high: float, chroma: float = 0.4) -> Colour:
    """Return a random colour of a brightness between low and high; chroma 0 is grey."""
    hue = rng.uniform(-chroma, chroma, 3)
    red, green, blue = np.clip(rng.uniform(low, high) * (1.0 + hue - hue.mean()), 8.0, 248.0)
    return float(red), float(green), float(blue)


def plaster(rng: Generator, width_m: float, height_m: float, colour: Colour) -> Image:
    """Return painted woodchip: blotches a hand wide and raised chips a centimetre wide."""
    size = size_px(width_m, height_m)
    blotches = _tint(noise(rng, size, (200, 200), 4), colour, 0.06)
    chips = noise(rng, size, (9, 9), 2)
    relief = chips - np.roll(chips, (2, 2), axis=(0, 1))  # lit from the upper left
    return to_image(blotches * (1.0 + 0.07 * relief[..., None] * (np.abs(chips[..., None]) > 0.7)))


def bricks(rng: Generator, width_m: float, height_m: float, colour: Colour) -> Image:
    """Return a wall of bricks 24 x 7 cm, each with its own shade, in pale mortar."""
    width, height = size_px(width_m, height_m)
    y_m, x_m = np.mgrid[:height, :width].astype(np.float32) / TEXELS_PER_M
    row = (y_m / 0.085).astype(int)
    x_m = x_m + 0.126 * (row % 2) + 0.02 * rng.random(row.max() + 1, np.float32)[row]
    column = (x_m / 0.252).astype(int)
    shades = rng.normal(1.0, 0.16, (row.max() + 1, column.max() + 1, 1))
    shades = shades + rng.normal(0.0, 0.04, (*shades.shape[:2], 3))
    image = np.asarray(colour) * shades[row, column]
    image *= 1.0 + 0.10 * noise(rng, (width, height), (10, 10))[..., None]
    ragged = 0.0025 * noise(rng, (width, height), (8, 8), 2)
    mortar = (y_m % 0.085 + ragged < 0.013) | (x_m % 0.252 + ragged < 0.013)
    grey = 175 + 12 * noise(rng, (width, height), (5, 5), 2)
    return to_image(np.where(mortar[..., None], grey[..., None], image))


def planks(
    rng: Generator,
    width_m: float,
    height_m: float,
    colour: Colour,
    board_m: tuple[float, float] = (1.1, 0.11),
) -> Image:
    """Return boards lying along the width, each with its own tone, grain and knots."""
    width, height = size_px(width_m, height_m)
    y_m, x_m = np.mgrid[:height, :width].astype(np.float32) / TEXELS_PER_M
    row = (y_m / board_m[1]).astype(int)
    x_m = x_m + board_m[0] * rng.random(row.max() + 1, np.float32)[row]
    column = (x_m / board_m[0]).astype(int)
    tones = rng.normal(1.0, 0.13, (row.max() + 1, column.max() + 1))
    grain = noise(rng, (width, height), (90, 5), 3)
    knots = np.maximum(noise(rng, (width, height), (40, 14), 1) - 2.0, 0.0)
    image = np.asarray(colour) * (tones[row, column] + 0.09 * grain - 0.5 * knots)[..., None]
    gap = (y_m % board_m[1] < 0.006) | (x_m % board_m[0] < 0.006)
    return to_image(np.where(gap[..., None], 0.35 * image, image))


def panelling(rng: Generator, width_m: float, height_m: float, colour: Colour) -> Image:
    """Return upright boards."""
    lying = planks(rng, height_m, width_m, colour, (1.7, 0.14))
    return np.ascontiguousarray(lying.transpose(1, 0, 2))


def wood(rng: Generator, width_m: float, height_m: float, colour: Colour) -> Image:
    """Return one piece of veneer, grain along the width."""
    size = size_px(width_m, height_m)
    rings = np.sin(2.5 * noise(rng, size, (260, 40), 2)) + 0.6 * noise(rng, size, (80, 4), 2)
    return to_image(_tint(rings.astype(np.float32), colour, 0.11))


def wallpaper(rng: Generator, width_m: float, height_m: float, colour: Colour) -> Image:
    """Return leaves and blossoms strewn over a plain ground, no two alike."""
    width, height = size_px(width_m, height_m)
    image = _tint(noise(rng, (width, height), (160, 160), 4), colour, 0.05)
    for _ in range(round(90 * width_m * height_m)):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        ink = np.asarray(colour) * rng.uniform(0.45, 0.8) + rng.normal(0.0, 12.0, 3)
        length, turn = int(rng.integers(5, 16)), float(rng.uniform(0, 360))
        for petal in range(int(rng.choice([1, 1, 2, 5]))):
            angle = turn + 72 * petal
            direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            tip = np.round(centre + length * direction).astype(int).tolist()
            axes = (length, max(2, length // 3))
            cv2.ellipse(image, tip, axes, angle, 0, 360, ink.tolist(), -1, cv2.LINE_AA)
    return to_image(image)


def cloth(rng: Generator, width_m: float, height_m: float, colour: Colour) -> Image:
    """Return woven cloth with uneven stripes across and along."""
    width, height = size_px(width_m, height_m)
    weave = noise(rng, (width, height), (3, 3), 1)
    along = rng.normal(0.0, 1.0, height // 14 + 1).repeat(14)[:height, None]
    across = rng.normal(0.0, 1.0, width // 22 + 1).repeat(22)[None, :width]
    return to_image(_tint((0.14 * (along + across) + 0.07 * weave).astype(np.float32), colour, 1.0))

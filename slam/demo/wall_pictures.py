# SPDX-License-Identifier: Apache-2.0
"""What hangs on walls and lies about: pictures, posters, pages, screens, windows, book spines.

Each is a material (see textures) drawn afresh from the random generator: the landmarks of a room.
"""

import string

import cv2
import numpy as np
from numpy.random import Generator

from slam.demo.textures import TEXELS_PER_M, Colour, Image, colour_of, noise, size_px, to_image


def landscape(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return hills behind hills under a sky with a sun."""
    width, height = size_px(width_m, height_m)
    ramp = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    sky = rng.uniform((90, 130, 190), (170, 190, 235)).astype(np.float32)
    near = rng.uniform((50, 70, 30), (130, 120, 75)).astype(np.float32)
    image = sky * (1 - ramp) + np.float32(235) * ramp + np.zeros((1, width, 1), np.float32)
    image += 9 * noise(rng, (width, height), (60, 18))[..., None]
    sun = (int(rng.integers(width)), int(height * rng.uniform(0.1, 0.4)))
    cv2.circle(image, sun, max(3, height // 12), (250, 235, 180), -1, cv2.LINE_AA)
    rows = np.arange(height)[:, None]
    for layer in np.linspace(0.35, 1.0, 6):
        ridge = height * (layer - 0.05) - height * 0.09 * noise(rng, (width, 1), (width // 3, 2), 5)
        hill = near * (1.25 - 0.75 * layer) + 90 * (1 - layer)
        shaded = hill * (1 + 0.16 * noise(rng, (width, height), (12, 6))[..., None])
        image = np.where((rows > ridge)[..., None], shaded, image)
    return to_image(image)


def abstract(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return overlapping discs, bars and strokes in a handful of colours."""
    width, height = size_px(width_m, height_m)
    palette = [colour_of(rng, 15, 245) for _ in range(5)]
    image = np.full((height, width, 3), palette[0], np.float32)
    for _ in range(28):
        ink = palette[int(rng.integers(1, 5))]
        a, b = (rng.uniform(0, 1, (2, 2)) * (width, height)).astype(int).tolist()
        kind, radius = int(rng.integers(4)), int(min(width, height) * rng.uniform(0.03, 0.2))
        thickness = max(1, radius // 4)
        if kind < 2:
            cv2.circle(image, a, radius, ink, thickness if kind else -1, cv2.LINE_AA)
        elif kind == 2:
            cv2.line(image, a, b, ink, thickness, cv2.LINE_AA)
        else:
            cv2.rectangle(image, a, [a[0] + radius * 2, a[1] + radius], ink, -1)
    return to_image(image + 5 * noise(rng, (width, height), (6, 6), 2)[..., None])


def contours(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return a map: land and sea in height bands, with contour lines and a grid."""
    size = size_px(width_m, height_m)
    relief = noise(rng, size, (size[0] // 2 + 4, size[1] // 2 + 4), 5)
    palette = np.array([colour_of(rng, 70, 240) for _ in range(8)])
    band = np.clip((relief * 2.2 + 4).astype(int), 0, 7)
    image = palette[band]
    lines = cv2.morphologyEx(band.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8))
    image[lines > 0] *= 0.45
    image[:: size[1] // 6 + 1] *= 0.7
    image[:, :: size[0] // 8 + 1] *= 0.7
    return to_image(image)


def page(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return a printed notice: a headline, lines of words in two columns, a picture."""
    width, height = size_px(width_m, height_m)
    image = np.full((height, width, 3), rng.uniform(205, 250, 3), np.uint8)
    ink = colour_of(rng, 10, 110)
    _write(image, rng, (width // 14, height // 6), height / 10, width, ink)
    line = max(8, height // 26)
    for y in range(height // 5, height - line, line):
        for x in (width // 14, width * 8 // 15):
            _write(image, rng, (x, y + line // 2), 0.62 * line, x + width * 2 // 5, ink)
    x, y = (int(s * rng.uniform(0.08, 0.5)) for s in (width, height))
    inset = abstract(rng, 0.45 * width_m, 0.3 * height_m)
    y = max(y, height // 5)
    image[y : y + inset.shape[0], x : x + inset.shape[1]] = inset[: height - y, : width - x]
    return image


def _write(
    image: Image, rng: Generator, start: tuple[int, int], height_px: float, end_x: int, ink: Colour
) -> None:
    """Draw one line of made-up words from the baseline `start` up to the column `end_x`."""
    scale = height_px / 30.0
    letters = rng.choice(list(string.ascii_letters + " " * 9), 90)
    count = max(1, int((end_x - start[0]) / (19.0 * scale + 1e-9)))
    thickness = max(1, round(1.6 * scale))
    text = "".join(letters[:count])
    cv2.putText(image, text, start, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, thickness, cv2.LINE_AA)


def framed(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return a picture of any kind in a frame, some with a pale mount."""
    kinds = (landscape, abstract, contours, page)
    image = kinds[int(rng.integers(len(kinds)))](rng, width_m, height_m)
    mount = round(TEXELS_PER_M * rng.choice([0.0, 0.03, 0.05]))
    size = size_px(width_m, height_m)
    if mount:
        cv2.rectangle(image, (0, 0), size, (232, 228, 216), 2 * mount)
    cv2.rectangle(image, (0, 0), size, colour_of(rng, 15, 120), 2 * round(0.018 * TEXELS_PER_M))
    return image


def window(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return a window: white bars before a cloudy sky and a row of houses."""
    width, height = size_px(width_m, height_m)
    clouds = noise(rng, (width, height), (150, 60), 4)[..., None]
    image = np.array((165, 190, 215), np.float32) + np.array((16, 12, 8), np.float32) * clouds
    x = 0
    while x < width:
        w, top = int(rng.integers(40, 110)), int(height * rng.uniform(0.35, 0.75))
        image[top:, x : x + w] = colour_of(rng, 80, 170, 0.15)
        for y in range(top + 8, height, 18):
            for left in range(x + 6, min(x + w, width) - 10, 14):
                image[y : y + 9, left : left + 7] = rng.choice([45.0, 75.0, 215.0])
        x += w
    image *= 1.0 + 0.04 * noise(rng, (width, height), (6, 6), 2)[..., None]
    for column in (0, width // 2, width):
        cv2.line(image, (column, 0), (column, height), (235, 235, 230), 22)
    for row in (0, height // 3, height):
        cv2.line(image, (0, row), (width, row), (235, 235, 230), 22)
    return to_image(image)


def screen(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return a monitor showing a dark editor full of coloured words."""
    width, height = size_px(width_m, height_m)
    image = np.full((height, width, 3), (28, 30, 38), np.uint8)
    for y in range(14, height - 6, 11):
        x = 10 + 14 * int(rng.integers(4))
        end_x = int(width * rng.uniform(0.3, 0.95))
        _write(image, rng, (x, y), 8.0, end_x, colour_of(rng, 90, 250))
    cv2.rectangle(image, (0, 0), (width, height), (12, 12, 12), 10)
    return image


def spine(rng: Generator, width_m: float, height_m: float) -> Image:
    """Return the back of a book: bands and a title that runs down it."""
    width, height = size_px(width_m, height_m)
    image = np.full((width, height, 3), colour_of(rng, 25, 215), np.uint8)  # lying, turned below
    for _ in range(int(rng.integers(1, 4))):
        x, band = int(rng.integers(height)), colour_of(rng, 20, 240)
        image[:, x : x + int(rng.integers(2, 12))] = band
    ink = (240.0, 235.0, 215.0) if image.mean() < 120 else (25.0, 20.0, 20.0)
    _write(image, rng, (height // 10, width * 3 // 4), 0.6 * width, int(0.85 * height), ink)
    worn = image * (1 + 0.06 * noise(rng, (height, width), (4, 4), 2)[..., None])
    return np.ascontiguousarray(np.rot90(to_image(worn), -1))

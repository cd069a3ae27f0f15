# SPDX-License-Identifier: Apache-2.0
"""What stands and hangs in a room: each piece is a list of panels in its own frame.

Pieces stand on y = 0 with their back at z = 0, x from their middle, front towards +z. Sizes are
width, height, depth in metres.
"""

from functools import partial

import numpy as np
from numpy.random import Generator

from slam.demo.panels import Panel, Point, box, sheet, turned
from slam.demo.textures import Colour, Material, cloth, colour_of, panelling, plaster, wood
from slam.demo.wall_pictures import abstract, contours, framed, screen, spine
from slam.types import FloatArray


def picture(
    T: FloatArray,
    centre: Point,
    width_m: float,
    height_m: float,
    rng: Generator,
    material: Material = framed,
) -> list[Panel]:
    """Return a picture hanging 2 cm before the wall."""
    low = (centre[0] - width_m / 2, centre[1] - height_m / 2, centre[2])
    frame = partial(plaster, colour=colour_of(rng, 20, 120))
    return box(T, low, (width_m, height_m, 0.02), rng, frame, material)


def bookcase(T: FloatArray, width_m: float, height_m: float, rng: Generator) -> list[Panel]:
    """Return an open bookcase 30 cm deep, a board every 30 cm or so, filled with books."""
    material, depth, thick = _veneer(rng), 0.30, 0.025
    left, shelves = -width_m / 2, max(2, round(height_m / 0.33))
    pitch = (height_m - thick) / shelves
    panels = box(T, (left, 0, 0), (width_m, height_m, 0.01), rng, material)
    for x in (left, -left - thick):
        panels += box(T, (x, 0, 0), (thick, height_m, depth), rng, material)
    board = (width_m - 2 * thick, thick, depth)
    for shelf in range(shelves + 1):
        panels += box(T, (left + thick, shelf * pitch, 0), board, rng, material)
    inner = (width_m - 2 * thick - 0.02) * rng.uniform(0.7, 1.0, shelves)
    for shelf in range(shelves):
        low = (left + thick + 0.01, shelf * pitch + thick, 0.03)
        panels += _books(T, low, inner[shelf], pitch - thick - 0.02, rng)
    return panels


def table(T: FloatArray, size: Point, rng: Generator) -> list[Panel]:
    """Return a table: a top on four legs."""
    (w, h, d), material = size, _veneer(rng)
    panels = box(T, (-w / 2, h - 0.04, 0), (w, 0.04, d), rng, material)
    for x in (-w / 2 + 0.03, w / 2 - 0.08):
        for z in (0.03, d - 0.08):
            panels += box(T, (x, 0, z), (0.05, h - 0.04, 0.05), rng, material)
    return panels


def clutter(T: FloatArray, size: Point, rng: Generator, count: int) -> list[Panel]:
    """Return tins, parcels and books strewn over the top of something of that size."""
    w, h, d = size
    panels: list[Panel] = []
    for x in np.linspace(-w / 2 + 0.1, w / 2 - 0.1, count):
        z = rng.uniform(0.1, max(0.11, d - 0.15))
        part = turned(T, (float(x), h, z), rng.uniform(-35, 35))
        if rng.random() < 0.35:
            radius, tall = rng.uniform(0.035, 0.06), rng.uniform(0.1, 0.25)
            panels += tube(part, radius, tall, rng, abstract)
        else:
            a, b, c = rng.uniform(0.06, 0.18, 3)
            front = contours if rng.random() < 0.4 else abstract
            cover = partial(cloth, colour=colour_of(rng, 60, 220))
            panels += box(part, (-a / 2, 0, -c / 2), (a, b, c), rng, cover, front)
    return panels


def desk(T: FloatArray, rng: Generator) -> list[Panel]:
    """Return a desk with a monitor, a keyboard, books and things on it, and a chair before it."""
    panels = table(T, (1.5, 0.74, 0.6), rng)
    dark, grey = partial(plaster, colour=(45, 45, 50)), partial(cloth, colour=(60, 60, 65))
    shown = turned(T, (rng.uniform(-0.3, 0.1), 0.74, 0.18), rng.uniform(-12, 12))
    panels += box(shown, (-0.03, 0, 0), (0.06, 0.12, 0.04), rng, dark)
    panels += box(shown, (-0.29, 0.1, 0.03), (0.58, 0.35, 0.03), rng, dark, screen)
    panels += box(shown, (-0.21, 0, 0.18), (0.42, 0.02, 0.14), rng, grey)
    panels += _books(T, (0.40, 0.74, 0.05), 0.3, 0.3, rng)
    panels += clutter(turned(T, (-0.58, 0, 0)), (0.3, 0.74, 0.5), rng, 2)
    return panels + chair(turned(T, (rng.uniform(0.2, 0.5), 0, 0.45), rng.uniform(-40, 40)), rng)


def chair(T: FloatArray, rng: Generator) -> list[Panel]:
    """Return a chair with a woven seat and back."""
    cover = partial(cloth, colour=colour_of(rng, 50, 200))
    panels = table(turned(T, (0, 0, -0.21)), (0.42, 0.44, 0.42), rng)
    panels += box(T, (-0.21, 0.44, -0.21), (0.42, 0.05, 0.42), rng, cover)
    return panels + box(T, (-0.21, 0.49, 0.19), (0.42, 0.42, 0.03), rng, cover)


def cupboard(T: FloatArray, size: Point, rng: Generator) -> list[Panel]:
    """Return a closed cupboard with boarded doors and things on top."""
    w, h, d = size
    front = partial(panelling, colour=colour_of(rng, 70, 190))
    panels = box(T, (-w / 2, 0, 0), (w, h, d), rng, _veneer(rng), front)
    return panels + clutter(T, size, rng, max(1, int(w / 0.28)))


def curtain(T: FloatArray, width_m: float, height_m: float, rng: Generator) -> list[Panel]:
    """Return a curtain in folds, 8 cm deep."""
    x = np.linspace(-width_m / 2, width_m / 2, 11)
    z = 0.04 * (-1.0) ** np.arange(11)
    material = partial(cloth, colour=colour_of(rng, 60, 200))
    return sheet(T, np.stack([x, z], axis=1), height_m, rng, material)


def tube(
    T: FloatArray, radius_m: float, height_m: float, rng: Generator, material: Material
) -> list[Panel]:
    """Return an open round vessel: a tin, a vase, a bin."""
    angles = np.linspace(-np.pi, np.pi, 13)
    outline = radius_m * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    return sheet(T, outline, height_m, rng, material)


def _books(
    T: FloatArray, low: Point, width_m: float, height_m: float, rng: Generator
) -> list[Panel]:
    """Return a row of upright books of uneven size, with a gap here and there."""
    panels: list[Panel] = []
    x = low[0]
    while True:
        thick, tall, deep = rng.uniform((0.02, 0.65, 0.13), (0.06, 0.95, 0.21))
        if x + thick > low[0] + width_m:
            return panels
        if rng.random() > 0.08:
            cover = partial(plaster, colour=colour_of(rng, 30, 200))
            size = (thick, tall * height_m, deep)
            panels += box(T, (x, low[1], low[2]), size, rng, cover, spine)
        x += thick + 0.002


def _veneer(rng: Generator) -> Material:
    """Return a wood of random tone, from beech to walnut, sometimes painted."""
    tone = rng.uniform(0.45, 1.0)
    natural: Colour = (215.0 * tone, 165.0 * tone**1.2, 110.0 * tone**1.4)
    return partial(wood, colour=natural if rng.random() < 0.7 else colour_of(rng, 60, 200))

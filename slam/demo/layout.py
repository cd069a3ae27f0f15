# SPDX-License-Identifier: Apache-2.0
"""Where things are: four unlike walls, each with furniture of its own, round an empty middle."""

from functools import partial

import numpy as np
from numpy.random import Generator

from slam.demo import furniture, textures, wall_pictures
from slam.demo.panels import Panel, box, panel, turned
from slam.demo.textures import Material, colour_of
from slam.geometry.se3 import from_rotation_translation
from slam.types import FloatArray


def furnished_room(rng: Generator, width_m: float, depth_m: float, height_m: float) -> list[Panel]:
    """Return the panels of a room: floor at z = 0, its middle at the origin, x along the width."""
    themes = (_gallery, _library, _study, _parlour)
    panels = _floor_and_ceiling(width_m, depth_m, height_m, rng)
    for side, kind in enumerate(rng.permutation(len(themes))):
        length_m, distance_m = (width_m, depth_m / 2) if side % 2 else (depth_m, width_m / 2)
        panels += themes[kind](wall_frame(side * np.pi / 2, distance_m), length_m, height_m, rng)
    return panels


def wall_frame(azimuth_rad: float, distance_m: float) -> FloatArray:
    """Return T_world_wall: x right and y up as the wall is seen, z into the room, from its foot."""
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    R_world_wall = np.array([[s, 0.0, -c], [-c, 0.0, -s], [0.0, 1.0, 0.0]])
    return from_rotation_translation(R_world_wall, np.array([c, s, 0.0]) * distance_m)


def _floor_and_ceiling(w: float, d: float, h: float, rng: Generator) -> list[Panel]:
    """Return boards with a rug on them, and a plastered ceiling."""
    T = np.eye(4)
    boards = textures.planks(rng, w, d, (165.0, 120.0, 80.0))
    rug = textures.cloth(rng, 2.2, 1.5, colour_of(rng, 60, 190))
    ceiling = textures.plaster(rng, w, d, (215.0, 213.0, 205.0))
    return [
        panel(T, (-w / 2, d / 2, 0), (w, 0, 0), (0, -d, 0), boards),
        panel(T, (-1.1, 0.75, 0.008), (2.2, 0, 0), (0, -1.5, 0), rug),
        panel(T, (-w / 2, -d / 2, h), (w, 0, 0), (0, d, 0), ceiling),
    ]


def _gallery(T: FloatArray, length_m: float, height_m: float, rng: Generator) -> list[Panel]:
    """Return a painted wall hung with pictures, a long sideboard before it."""
    paint = partial(textures.plaster, colour=colour_of(rng, 170, 215, 0.15))
    half = length_m / 2 - 0.15
    panels = _wall(T, length_m, height_m, rng, paint)
    panels += _hang(T, (-half, half), (1.05, 1.75), rng)
    panels += _hang(T, (-half, half), (1.8, 2.4), rng)
    board = turned(T, (rng.uniform(-0.4, 0.4), 0, 0.02))
    return panels + furniture.cupboard(board, (1.8, 0.72, 0.42), rng)


def _library(T: FloatArray, length_m: float, height_m: float, rng: Generator) -> list[Panel]:
    """Return a brick wall with bookcases of uneven height, posters above the low ones."""
    half = length_m / 2 - 0.1
    panels = _wall(T, length_m, height_m, rng, partial(textures.bricks, colour=(160.0, 85.0, 65.0)))
    x = -half
    while (w := rng.uniform(0.7, 1.25)) < half - 0.6 - x:
        h, foot = rng.choice([1.05, 1.4, 1.75, 2.05]), turned(T, (x + w / 2, 0, 0.01))
        panels += furniture.bookcase(foot, w, h, rng)
        if h < 1.5:
            panels += _hang(T, (x, x + w), (h + 0.35, 2.45), rng)
            panels += furniture.clutter(foot, (w, h, 0.3), rng, 3)
        x += w + rng.uniform(0.05, 0.3)
    panels += _hang(T, (x, half), (1.0, 2.0), rng)
    corner = turned(T, (half - 0.25, 0, 0.3))
    return panels + furniture.tube(corner, 0.14, 0.32, rng, wall_pictures.contours)


def _study(T: FloatArray, length_m: float, height_m: float, rng: Generator) -> list[Panel]:
    """Return a boarded wall with a desk, a shelf of books above it, and notices."""
    boards = partial(textures.panelling, colour=colour_of(rng, 120, 200, 0.25))
    half, middle = length_m / 2 - 0.15, rng.uniform(-0.4, 0.4)
    panels = _wall(T, length_m, height_m, rng, boards)
    panels += furniture.desk(turned(T, (middle, 0, 0.02)), rng)
    panels += furniture.bookcase(turned(T, (middle, 1.45, 0.01)), 1.3, 0.68, rng)
    for left, right in ((-half, middle - 0.85), (middle + 0.85, half)):
        panels += _hang(T, (left, right), (1.15, 1.75), rng)
        panels += _hang(T, (left, right), (1.8, 2.4), rng)
        foot, size = ((left + right) / 2, 0, 0.02), (right - left - 0.1, rng.uniform(0.5, 0.9), 0.4)
        panels += furniture.cupboard(turned(T, foot), size, rng)
    return panels


def _parlour(T: FloatArray, length_m: float, height_m: float, rng: Generator) -> list[Panel]:
    """Return a papered wall with a window, curtains, a table between chairs, and pictures."""
    paper = partial(textures.wallpaper, colour=colour_of(rng, 150, 215, 0.2))
    half, middle = length_m / 2 - 0.15, rng.uniform(-0.3, 0.3)
    panels = _wall(T, length_m, height_m, rng, paper)
    panels += furniture.picture(T, (middle, 1.6, 0), 1.5, 1.25, rng, wall_pictures.window)
    for x in (middle - 0.95, middle + 0.95):
        panels += furniture.curtain(turned(T, (x, 0.15, 0.07)), 0.35, 2.2, rng)
        panels += furniture.chair(turned(T, (x, 0, 0.42), rng.uniform(-40, 40)), rng)
    foot = turned(T, (middle, 0, 0.05))
    panels += furniture.table(foot, (1.1, 0.7, 0.55), rng)
    panels += furniture.clutter(foot, (1.1, 0.7, 0.5), rng, 4)
    for left, right in ((-half, middle - 1.2), (middle + 1.2, half)):
        panels += _hang(T, (left, right), (1.1, 2.1), rng)
    return panels


def _wall(
    T: FloatArray, length_m: float, height_m: float, rng: Generator, material: Material
) -> list[Panel]:
    """Return a bare wall with a skirting board."""
    texture = material(rng, length_m, height_m)
    bare = panel(T, (-length_m / 2, height_m, 0), (length_m, 0, 0), (0, -height_m, 0), texture)
    board = partial(textures.wood, colour=(225.0, 220.0, 205.0))
    return [bare, *box(T, (-length_m / 2, 0, 0), (length_m, 0.09, 0.015), rng, board)]


def _hang(
    T: FloatArray, x_m: tuple[float, float], y_m: tuple[float, float], rng: Generator
) -> list[Panel]:
    """Return pictures of uneven size side by side, filling a strip of a wall."""
    panels: list[Panel] = []
    (x, right), (low, high) = x_m, y_m
    while x < right - 0.25:
        w = min(float(rng.uniform(0.3, 0.85)), right - x)
        h = min(float(rng.uniform(0.35, 0.8)), high - low)
        y = float(rng.uniform(low + h / 2, high - h / 2))
        panels += furniture.picture(T, (x + w / 2, y, 0), w, h, rng)
        x += w + float(rng.uniform(0.06, 0.2))
    return panels

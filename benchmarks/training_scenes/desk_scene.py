# SPDX-License-Identifier: Apache-2.0
"""A cluttered table in a small room: what a hand-held camera looks at from an arm's length."""

from functools import partial

import numpy as np

from slam.demo import furniture, textures, wall_pictures
from slam.demo.layout import wall_frame
from slam.demo.panels import Panel, Point, box, panel, turned
from slam.demo.textures import Material, colour_of
from slam.geometry.se3 import from_rotation_translation
from slam.types import FloatArray

TABLE_HEIGHT_M = 0.74
_CEILING_M = 2.6
_WALL_M = 6.0
_APART_M = 0.13

_FRONTS: tuple[Material, ...] = (
    wall_pictures.abstract,
    wall_pictures.contours,
    wall_pictures.framed,
    wall_pictures.screen,
    wall_pictures.spine,
)
_COVERS = (textures.plaster, textures.cloth, textures.wood, textures.panelling)


def table_size(rng: np.random.Generator) -> tuple[float, float]:
    """Return a random width and depth of a table, metres."""
    return float(rng.uniform(1.4, 3.2)), float(rng.uniform(0.8, 2.0))


def cluttered_table(rng: np.random.Generator, width_m: float, depth_m: float) -> list[Panel]:
    """Return the panels of a table full of things, and of what stands and hangs around it.

    The floor is z = 0 and the table's middle above the origin; its width is along y.
    """
    R_world_table = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    T = from_rotation_translation(R_world_table, np.zeros(3))
    size = (width_m, 0.04, depth_m)
    panels = box(T, (-width_m / 2, TABLE_HEIGHT_M - 0.04, -depth_m / 2), size, rng, _cover(rng))
    panels += _floor_and_ceiling(rng, T)
    for side in range(4):
        distance_m = float(rng.uniform(1.6, 3.0))
        panels += _wall(rng, wall_frame(side * np.pi / 2, distance_m))
    return panels + _things(rng, T, width_m, depth_m)


def _floor_and_ceiling(rng: np.random.Generator, T: FloatArray) -> list[Panel]:
    material = textures.planks if rng.random() < 0.5 else textures.cloth
    floor = material(rng, _WALL_M, _WALL_M, colour_of(rng, 40, 200))
    ceiling = textures.plaster(rng, _WALL_M, _WALL_M, (215.0, 213.0, 205.0))
    half, across = _WALL_M / 2, (_WALL_M, 0.0, 0.0)
    return [
        panel(T, (-half, 0.0, half), across, (0.0, 0.0, -_WALL_M), floor),
        panel(T, (-half, _CEILING_M, -half), across, (0.0, 0.0, _WALL_M), ceiling),
    ]


def _wall(rng: np.random.Generator, T: FloatArray) -> list[Panel]:
    """Return a wall with some pictures on it and some boxy furniture before it."""
    materials = (textures.plaster, textures.bricks, textures.wallpaper)
    colour = colour_of(rng, 60, 230)
    texture = materials[int(rng.integers(len(materials)))](rng, _WALL_M, _CEILING_M, colour)
    across, down = (_WALL_M, 0.0, 0.0), (0.0, -_CEILING_M, 0.0)
    panels = [panel(T, (-_WALL_M / 2, _CEILING_M, 0.0), across, down, texture)]
    for _ in range(int(rng.integers(1, 7))):
        centre = (float(rng.uniform(-2.2, 2.2)), float(rng.uniform(0.6, 1.9)), 0.0)
        width_m, height_m = rng.uniform(0.2, 1.0, 2)
        panels += furniture.picture(T, centre, width_m, height_m, rng, _front(rng))
    for _ in range(int(rng.integers(0, 4))):
        w, h, d = rng.uniform((0.3, 0.4, 0.2), (1.2, 1.8, 0.6))
        x = float(rng.uniform(-2.0, 2.0))
        panels += box(T, (x - w / 2, 0.0, 0.0), (w, h, d), rng, _cover(rng), _front(rng))
    return panels


def _things(rng: np.random.Generator, T: FloatArray, width_m: float, depth_m: float) -> list[Panel]:
    panels: list[Panel] = []
    spots: list[tuple[float, float]] = []
    reach = np.array([width_m, depth_m]) / 2 - 0.08
    for _ in range(int(rng.integers(30, 75))):
        for _ in range(20):  # a free spot, where there is one
            x, z = rng.uniform(-reach, reach)
            if all(abs(x - a) + abs(z - b) > _APART_M for a, b in spots):
                break
        spots.append((float(x), float(z)))
        stand = turned(T, (float(x), TABLE_HEIGHT_M, float(z)), rng.uniform(-180, 180))
        panels += _thing(rng, stand)
    return panels


def _thing(rng: np.random.Generator, T: FloatArray) -> list[Panel]:
    """Return a sheet or keyboard, a screen, a parcel or a tin: boxes, closed at the back."""
    kinds: tuple[tuple[float, Point, Point], ...] = (
        (0.25, (0.15, 0.004, 0.12), (0.45, 0.03, 0.35)),
        (0.17, (0.3, 0.25, 0.04), (0.6, 0.45, 0.3)),
        (0.38, (0.05, 0.04, 0.05), (0.25, 0.28, 0.25)),
        (0.2, (0.03, 0.08, 0.03), (0.08, 0.25, 0.08)),
    )
    _, least, most = kinds[rng.choice(len(kinds), p=[share for share, _, _ in kinds])]
    w, h, d = rng.uniform(least, most)
    front = _front(rng) if rng.random() < 0.6 else None
    panels = box(T, (-w / 2, 0.0, -d / 2), (w, h, d), rng, _cover(rng), front)
    back = _cover(rng)(rng, w, h)
    return [*panels, panel(T, (w / 2, h, -d / 2), (-w, 0.0, 0.0), (0.0, -h, 0.0), back)]


def _cover(rng: np.random.Generator) -> Material:
    kind = _COVERS[int(rng.integers(len(_COVERS)))]
    return partial(kind, colour=colour_of(rng, 20, 235))


def _front(rng: np.random.Generator) -> Material:
    return _FRONTS[int(rng.integers(len(_FRONTS)))]

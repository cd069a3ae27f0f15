# SPDX-License-Identifier: Apache-2.0
"""Textured rectangles, the solids put together from them, and how lamps light them.

What is put together is given in a frame of its own: x right and y up as seen from the front, z to
the viewer. `T` takes it to the world (T_world_local).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import open3d as o3d
from numpy.random import Generator
from numpy.typing import NDArray

from slam.demo.textures import Image, Material, to_image
from slam.geometry.se3 import from_rotation_translation
from slam.types import FloatArray

_CELL_M = 0.08  # of the light maps
_CLEARANCE_M = 0.004  # from a surface to the points before it whose light is computed
_LAMP_SAMPLES, _LAMP_SIZE_M, _LAMP_BRIGHTNESS = 4, 0.12, 1.75
_SKY_SAMPLES, _SKY_REACH_M, _SKY_BRIGHTNESS = 12, 0.8, 0.55

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Panel:
    """A rectangle with a picture on it.

    Attributes:
        corner_m: (3,) world, where the texture's upper left corner is.
        right_m, down_m: (3,) world, the edges along the texture's rows and columns.
        texture: (h, w, 3) uint8 RGB.
    """

    corner_m: FloatArray
    right_m: FloatArray
    down_m: FloatArray
    texture: Image


def panel(T: FloatArray, corner: Point, right: Point, down: Point, texture: Image) -> Panel:
    """Return a panel given in a local frame, metres."""
    R = T[:3, :3]
    return Panel(R @ corner + T[:3, 3], R @ right, R @ down, texture)


def turned(T: FloatArray, at: Point, angle_deg: float = 0.0) -> FloatArray:
    """Return T_world_part of a part standing at a local point, turned about the upright axis."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    R_local_part = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return T @ from_rotation_translation(R_local_part, np.asarray(at))


def box(
    T: FloatArray,
    low: Point,
    size: Point,
    rng: Generator,
    sides: Material,
    front: Material | None = None,
) -> list[Panel]:
    """Return the five visible faces (not the back) of a box with its lowest corner at `low`."""
    (x, y, z), (w, h, d) = low, size
    top, bottom = sides(rng, w, d), sides(rng, w, d)
    left, right = sides(rng, d, h), sides(rng, d, h)
    face = (front or sides)(rng, w, h)
    return [
        panel(T, (x, y + h, z + d), (w, 0, 0), (0, -h, 0), face),
        panel(T, (x, y + h, z), (w, 0, 0), (0, 0, d), top),
        panel(T, (x, y, z + d), (w, 0, 0), (0, 0, -d), bottom),
        panel(T, (x, y + h, z), (0, 0, d), (0, -h, 0), left),
        panel(T, (x + w, y + h, z + d), (0, 0, -d), (0, -h, 0), right),
    ]


def sheet(
    T: FloatArray, outline_xz_m: FloatArray, height_m: float, rng: Generator, material: Material
) -> list[Panel]:
    """Return an upright sheet bent along an outline, one texture running over all its panels.

    It stands on y = 0; the (N, 2) outline runs from left to right as seen from the front.
    """
    steps = np.diff(outline_xz_m, axis=0)
    whole = material(rng, float(np.linalg.norm(steps, axis=1).sum()), height_m)
    pieces = np.array_split(whole, len(steps), axis=1)
    return [
        panel(T, (x, height_m, z), (dx, 0, dz), (0, -height_m, 0), np.ascontiguousarray(piece))
        for (x, z), (dx, dz), piece in zip(outline_xz_m[:-1], steps, pieces, strict=True)
    ]


def scene_of(panels: list[Panel]) -> o3d.t.geometry.RaycastingScene:
    """Return the panels' geometry for ray casting; panel i is triangles 2 i and 2 i + 1.

    Triangle 2 i starts at the texture's upper left, 2 i + 1 at its lower right: in both the
    barycentric coordinates run along the texture's edges, in the second one backwards.
    """
    corner = np.array([panel.corner_m for panel in panels])
    right = np.array([panel.right_m for panel in panels])
    down = np.array([panel.down_m for panel in panels])
    vertices = np.stack([corner, corner + right, corner + right + down, corner + down], axis=1)
    triangles = 4 * np.arange(len(panels))[:, None, None] + np.array([[0, 1, 3], [2, 3, 1]])
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.reshape(-1, 3).astype(np.float32)),
        o3d.core.Tensor(triangles.reshape(-1, 3).astype(np.uint32)),
    )
    return scene


def light(panels: list[Panel], lamps_m: FloatArray, rng: Generator) -> list[Panel]:
    """Return the panels as lit by (L, 3) lamps, world, with soft shadows, darker in the corners."""
    grids = [_grid(panel) for panel in panels]
    counts = [grid.shape[0] * grid.shape[1] for grid in grids]
    across = [np.cross(panel.down_m, panel.right_m) for panel in panels]
    normals = np.repeat([each / np.linalg.norm(each) for each in across], counts, axis=0)
    points_m = np.concatenate([grid.reshape(-1, 3) for grid in grids]) + _CLEARANCE_M * normals
    scene = scene_of(panels)
    brightness = np.zeros(len(points_m))
    for _ in range(_SKY_SAMPLES):
        # A unit vector plus the normal points anywhere above the surface, as often as its cosine.
        above = _unit(_unit(rng.standard_normal(points_m.shape)) + normals)
        brightness += _is_free(scene, points_m, above, _SKY_REACH_M)
    brightness *= _SKY_BRIGHTNESS / _SKY_SAMPLES
    for lamp_m in np.repeat(lamps_m, _LAMP_SAMPLES, axis=0):
        towards = lamp_m + rng.normal(0.0, _LAMP_SIZE_M, 3) - points_m
        distance_m = np.linalg.norm(towards, axis=1)
        cosine = np.maximum((towards * normals).sum(axis=1) / distance_m, 0.0)
        # The light does not grow without bound near the lamp.
        strength = _LAMP_BRIGHTNESS / _LAMP_SAMPLES / (1.0 + distance_m**2)
        brightness += _is_free(scene, points_m, towards, 1.0) * cosine * strength
    maps = np.split(brightness, np.cumsum(counts)[:-1])
    return [
        replace(panel, texture=_shaded(panel.texture, light_map.reshape(grid.shape[:2])))
        for panel, light_map, grid in zip(panels, maps, grids, strict=True)
    ]


def _grid(panel: Panel) -> FloatArray:
    """Return (rows, columns, 3) points, world, at the middles of the light map's cells."""
    columns, rows = (
        max(1, round(float(np.linalg.norm(edge)) / _CELL_M))
        for edge in (panel.right_m, panel.down_m)
    )
    s = (np.arange(columns)[None, :, None] + 0.5) / columns
    t = (np.arange(rows)[:, None, None] + 0.5) / rows
    return np.asarray(panel.corner_m + s * panel.right_m + t * panel.down_m)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _is_free(
    scene: o3d.t.geometry.RaycastingScene, points_m: FloatArray, ways: FloatArray, reach: float
) -> NDArray[np.bool_]:
    """Return (N,) whether nothing stands within `reach` times the (N, 3) ways from the points."""
    rays = np.concatenate([points_m, ways], axis=1).astype(np.float32)
    hidden = scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=reach)
    return np.asarray(~hidden.numpy(), np.bool_)


def _shaded(texture: Image, light_map: FloatArray) -> Image:
    height, width = texture.shape[:2]
    smooth = cv2.resize(cv2.blur(light_map, (3, 3)), (width, height))
    return to_image(texture * smooth[..., None].astype(np.float32))

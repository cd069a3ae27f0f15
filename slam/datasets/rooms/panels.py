# SPDX-License-Identifier: Apache-2.0
"""Textured rectangles, and the solids put together from them.

Furniture is laid out in its own frame: x right and y up as seen from the front, z to the viewer.
"""

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from slam.datasets.rooms.textures import Image, Material
from slam.se3 import from_rotation_translation
from slam.types import FloatArray

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

    @property
    def normal(self) -> FloatArray:
        """The (3,) unit normal on the side the picture is seen from, world."""
        across = np.cross(self.down_m, self.right_m)
        return np.asarray(across / np.linalg.norm(across))


def panel(
    T_world_local: FloatArray, corner: Point, right: Point, down: Point, texture: Image
) -> Panel:
    """Return a panel given in a local frame, metres."""
    R = T_world_local[:3, :3]
    return Panel(R @ corner + T_world_local[:3, 3], R @ right, R @ down, texture)


def turned(T_world_local: FloatArray, at: Point, angle_deg: float = 0.0) -> FloatArray:
    """Return T_world_part of a part standing at a local point, turned about the upright axis."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    R_local_part = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return T_world_local @ from_rotation_translation(R_local_part, np.asarray(at))


def box(
    T_world_local: FloatArray,
    low: Point,
    size: Point,
    rng: np.random.Generator,
    sides: Material,
    front: Material | None = None,
) -> list[Panel]:
    """Return the five visible faces (not the back) of a box with its lowest corner at `low`."""
    (x, y, z), (w, h, d) = low, size
    top, bottom = sides(rng, w, d), sides(rng, w, d)
    left, right = sides(rng, d, h), sides(rng, d, h)
    face = (front or sides)(rng, w, h)
    T = T_world_local
    return [
        panel(T, (x, y + h, z + d), (w, 0, 0), (0, -h, 0), face),
        panel(T, (x, y + h, z), (w, 0, 0), (0, 0, d), top),
        panel(T, (x, y, z + d), (w, 0, 0), (0, 0, -d), bottom),
        panel(T, (x, y + h, z), (0, 0, d), (0, -h, 0), left),
        panel(T, (x + w, y + h, z + d), (0, 0, -d), (0, -h, 0), right),
    ]


def sheet(
    T_world_local: FloatArray,
    outline_xz_m: FloatArray,
    height_m: float,
    rng: np.random.Generator,
    material: Material,
) -> list[Panel]:
    """Return an upright sheet bent along an outline, one texture running over all its panels.

    It stands on y = 0; the (N, 2) outline runs from left to right as seen from the front.
    """
    steps = np.diff(outline_xz_m, axis=0)
    whole = material(rng, float(np.linalg.norm(steps, axis=1).sum()), height_m)
    pieces = np.array_split(whole, len(steps), axis=1)
    down = (0.0, -height_m, 0.0)
    return [
        panel(T_world_local, (x, height_m, z), (dx, 0.0, dz), down, np.ascontiguousarray(piece))
        for (x, z), (dx, dz), piece in zip(outline_xz_m[:-1], steps, pieces, strict=True)
    ]


def scene_of(panels: list[Panel]) -> o3d.t.geometry.RaycastingScene:
    """Return the panels' geometry for ray casting; panel i is triangles 2 i and 2 i + 1.

    Triangle 2 i starts at the texture's upper left, 2 i + 1 at its lower right: in both the
    barycentric coordinates run along the texture's edges, in the second one backwards.
    """
    corner, right, down = (
        np.array([getattr(panel, name) for panel in panels])
        for name in ("corner_m", "right_m", "down_m")
    )
    vertices = np.stack([corner, corner + right, corner + right + down, corner + down], axis=1)
    triangles = 4 * np.arange(len(panels))[:, None, None] + np.array([[0, 1, 3], [2, 3, 1]])
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.reshape(-1, 3).astype(np.float32)),
        o3d.core.Tensor(triangles.reshape(-1, 3).astype(np.uint32)),
    )
    return scene

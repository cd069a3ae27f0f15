# SPDX-License-Identifier: Apache-2.0
"""Light that does not move: worked out once per room and multiplied into the textures."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from slam.datasets.rooms.panels import Panel, scene_of
from slam.datasets.rooms.textures import Image, to_image
from slam.types import FloatArray

_CELL_M = 0.08
_LAMP_SAMPLES = 4
_LAMP_SIZE_M = 0.12
_LAMP_BRIGHTNESS = 1.75
_SKY_SAMPLES = 12
_SKY_REACH_M = 0.8
_SKY_BRIGHTNESS = 0.55
_CLEARANCE_M = 0.004


@dataclass(frozen=True)
class _Surface:
    """Points just before a surface, (N, 3) world, and where their light may be kept away."""

    points_m: FloatArray
    normals: FloatArray
    scene: o3d.t.geometry.RaycastingScene

    def sees(self, directions: FloatArray, reach: float) -> NDArray[np.bool_]:
        """Return (N,) whether nothing stands within `reach` times the (N, 3) directions."""
        rays = np.concatenate([self.points_m, directions], axis=1).astype(np.float32)
        hidden = self.scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=reach)
        return np.asarray(~hidden.numpy(), np.bool_)


def light(panels: list[Panel], lamps_m: FloatArray, rng: np.random.Generator) -> list[Panel]:
    """Return the panels as lit by lamps with soft shadows, darker in the corners.

    Args:
        panels: the surfaces, which also stand in each other's light.
        lamps_m: (L, 3) positions, world.
        rng: places the samples on the lamps and in the sky.
    """
    grids = [_grid(panel) for panel in panels]
    counts = [grid.shape[0] * grid.shape[1] for grid in grids]
    normals = np.repeat([panel.normal for panel in panels], counts, axis=0)
    points_m = np.concatenate([grid.reshape(-1, 3) for grid in grids]) + _CLEARANCE_M * normals
    surface = _Surface(points_m, normals, scene_of(panels))
    brightness = _from_sky(surface, rng)
    for lamp_m in np.repeat(lamps_m, _LAMP_SAMPLES, axis=0):
        brightness += _from_lamp(surface, lamp_m + rng.normal(0.0, _LAMP_SIZE_M, 3))
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


def _from_lamp(surface: _Surface, lamp_m: FloatArray) -> FloatArray:
    """Return (N,) light from one point of a lamp; it does not grow without bound near the lamp."""
    towards = lamp_m - surface.points_m
    distance_m = np.linalg.norm(towards, axis=1)
    cosine = np.maximum((towards * surface.normals).sum(axis=1) / distance_m, 0.0)
    strength = _LAMP_BRIGHTNESS / _LAMP_SAMPLES / (1.0 + distance_m**2)
    return np.asarray(surface.sees(towards, 1.0) * cosine * strength)


def _from_sky(surface: _Surface, rng: np.random.Generator) -> FloatArray:
    """Return (N,) light from everywhere: less where few directions are free (ambient occlusion)."""
    free = np.zeros(len(surface.points_m))
    for _ in range(_SKY_SAMPLES):
        sphere = rng.standard_normal(surface.points_m.shape)
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        # A unit vector plus the normal points anywhere above the surface, as often as its cosine.
        above = sphere + surface.normals
        above /= np.linalg.norm(above, axis=1, keepdims=True)
        free += surface.sees(above, _SKY_REACH_M)
    return _SKY_BRIGHTNESS / _SKY_SAMPLES * free


def _shaded(texture: Image, light_map: FloatArray) -> Image:
    height, width = texture.shape[:2]
    smooth = cv2.resize(cv2.blur(light_map, (3, 3)), (width, height))
    return to_image(texture * smooth[..., None].astype(np.float32))

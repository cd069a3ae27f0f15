# SPDX-License-Identifier: Apache-2.0
"""A room that can be photographed: ray casting finds the surface, its texture gives the colour."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from slam.demo.layout import furnished_room
from slam.demo.panels import Panel, light, scene_of
from slam.demo.textures import TEXELS_PER_M, FloatImage, Image
from slam.types import Camera, FloatArray, Frame

ROOM_SIZE_M = (5.0, 4.0, 2.6)
LAMPS_M = np.array([[-0.9, 0.3, 2.2], [0.9, -0.3, 2.2], [0.0, 0.0, 1.5]])
_LEVELS = 4


@dataclass(frozen=True, eq=False)
class Room:
    """Textured rectangles, ready to be rendered.

    Attributes:
        scene: the geometry; rectangle i is triangles 2 i and 2 i + 1.
        texels: (N,) uint32, all textures at all levels of detail end to end, bytes R, G, B, 0.
        levels: (P * levels of detail, 3) int32, where each begins in `texels`, its width, height.
    """

    scene: o3d.t.geometry.RaycastingScene
    texels: NDArray[np.uint32]
    levels: NDArray[np.int32]


def build_room(seed: int) -> Room:
    """Return a furnished room of 5 x 4 x 2.6 m; the same seed gives the same room.

    The floor is z = 0, the origin its middle; everything stands within 0.9 m of the walls.
    """
    rng = np.random.default_rng([seed, 0x200])
    return assemble(light(furnished_room(rng, *ROOM_SIZE_M), LAMPS_M, rng))


def assemble(panels: list[Panel]) -> Room:
    """Return the panels as a room to be rendered; their textures are taken as lit."""
    images = [level for panel in panels for level in _levels_of_detail(panel.texture)]
    heights, widths = np.transpose([image.shape for image in images])
    starts = np.cumsum(heights * widths) - heights * widths
    levels = np.stack([starts, widths, heights], axis=1).astype(np.int32)
    return Room(scene_of(panels), np.concatenate([image.ravel() for image in images]), levels)


def _levels_of_detail(texture: Image) -> list[NDArray[np.uint32]]:
    """Return the texture at full, half, quarter, ... size, each texel in one number."""
    levels: list[NDArray[np.uint32]] = []
    image = np.dstack([texture, np.zeros(texture.shape[:2], np.uint8)])
    for _ in range(_LEVELS):
        levels.append(np.ascontiguousarray(image).view(np.uint32)[..., 0])
        half = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
        image = cv2.resize(image, half, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return levels


def render(room: Room, camera: Camera, T_world_cam: FloatArray, timestamp_s: float = 0.0) -> Frame:
    """Return what a perfect camera sees: no noise, depth exact to float32, 0 outside the room.

    T_world_cam is (4, 4), camera axes x right, y down, z forward; a lens distortion is rendered.
    """
    rays_cam = _rays_cam(camera)
    rays = np.empty((camera.height, camera.width, 6), np.float32)
    rays[..., :3] = T_world_cam[:3, 3]
    rays[..., 3:] = rays_cam @ T_world_cam[:3, :3].astype(np.float32).T
    hits = {name: hit.numpy() for name, hit in room.scene.cast_rays(o3d.core.Tensor(rays)).items()}
    missed = hits["primitive_ids"] == o3d.t.geometry.RaycastingScene.INVALID_ID
    triangles = np.where(missed, 0, hits["primitive_ids"]).astype(np.int32)
    depth_m = np.where(missed, 0.0, hits["t_hit"])  # rays have z = 1: length is depth
    uv = hits["primitive_uvs"]
    uv = np.where((triangles % 2 == 1)[..., None], 1.0 - uv, uv)
    facing = np.abs(np.einsum("hwc,hwc->hw", hits["primitive_normals"], rays[..., 3:]))
    facing /= np.linalg.norm(rays_cam, axis=2)
    # Seen at a slant a pixel covers more texels along than across: take the geometric mean.
    texels_per_px = TEXELS_PER_M / camera.fx * depth_m / np.sqrt(np.maximum(facing, 0.05))
    rgb = _colours(room, triangles // 2, uv, texels_per_px)
    rgb[missed] = 0
    return Frame(timestamp_s, rgb, depth_m)


@lru_cache(maxsize=4)
def _rays_cam(camera: Camera) -> FloatImage:
    """Return (H, W, 3) float32 viewing rays of the pixels, camera frame, z = 1; read-only."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    xy = cv2.undistortPoints(pixels, camera.matrix, np.array(camera.distortion))
    rays = np.dstack([xy.reshape(*u.shape, 2), np.ones(u.shape)]).astype(np.float32)
    rays.setflags(write=False)
    return rays


def _colours(
    room: Room, panels: NDArray[np.int32], uv: FloatImage, texels_per_px: FloatImage
) -> Image:
    """Return (H, W, 3) colours, bilinear, from textures whose texels are about a pixel large."""
    level = np.rint(np.log2(np.maximum(texels_per_px, 1.0))).astype(np.int32)
    entry = panels * _LEVELS + np.minimum(level, _LEVELS - 1)
    start, width, height = np.moveaxis(room.levels[entry], -1, 0)
    x = np.clip(uv[..., 0] * width - 0.5, 0, width - 1).astype(np.float32)
    y = np.clip(uv[..., 1] * height - 0.5, 0, height - 1).astype(np.float32)
    left, top = x.astype(np.int32), y.astype(np.int32)
    to_right = (left < width - 1).astype(np.int32)
    to_below = (top < height - 1) * width
    at = start + top * width + left
    corners = np.stack([at, at + to_right, at + to_below, at + to_below + to_right])
    a, b, c, d = room.texels[corners].view(np.uint8).reshape(*corners.shape, 4)
    along, down = (x - left)[..., None], (y - top)[..., None]
    mixed = _mix(_mix(a, b, along), _mix(c, d, along), down)
    return (mixed[..., :3] + 0.5).astype(np.uint8)


def _mix(a: Image | FloatImage, b: Image | FloatImage, share_of_b: FloatImage) -> FloatImage:
    return np.asarray(a * (1.0 - share_of_b) + b * share_of_b, np.float32)

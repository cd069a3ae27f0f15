# SPDX-License-Identifier: Apache-2.0
"""Pictures of a mesh, without a screen: rays that meet its triangles."""

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from slam.geometry import se3
from slam.output.mesh.fusion import Mesh
from slam.types import FloatArray

_WIDTH_PX, _HEIGHT_PX = 720, 540
_OPENING_DEG = 55.0
_FROM_ABOVE = np.array([0.6, 0.8])  # of the way that the whole is looked at, level and down
_OVER_THE_SHOULDER = np.array([0.3, -0.5, -0.1])  # of the distance: right, up and back
_BACKS = 6  # surfaces that a ray goes through from behind before it is given up
_BEHIND = 1e-4  # of the way to a surface, to be past it
_PAPER = (244, 245, 247)
_DARKEST = 0.45  # of its colour, a surface seen at a slant


def overview(mesh: Mesh, T_world_cam: FloatArray) -> NDArray[np.uint8]:
    """Return the whole map from above, what is seen from behind left out.

    The (K, 4, 4) cameras tell where up is.
    """
    up = _unit(-T_world_cam[:, :3, 1].mean(axis=0))
    ahead = T_world_cam[0, :3, 2]
    level, down = _FROM_ABOVE
    way = level * _unit(ahead - up * (ahead @ up)) - down * up
    low_m, high_m = np.percentile(mesh.points_m.astype(np.float64), (2, 98), axis=0)
    middle_m = 0.5 * (low_m + high_m)
    away_m = 0.5 * np.linalg.norm(high_m - low_m) / np.tan(np.radians(_OPENING_DEG) / 2.0)
    return _seen(mesh, middle_m - away_m * way, middle_m, up)


def closer(mesh: Mesh, T_world_cam: FloatArray, distance_m: float) -> NDArray[np.uint8]:
    """Return what a camera looked at, at this distance, from above its shoulder."""
    apart_m = distance_m * np.array([_OVER_THE_SHOULDER, [0.0, 0.0, 1.0]])
    eye_m, at_m = se3.transform(T_world_cam, apart_m)
    return _seen(mesh, eye_m, at_m, -T_world_cam[:3, 1])


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _seen(mesh: Mesh, eye_m: FloatArray, at_m: FloatArray, up: FloatArray) -> NDArray[np.uint8]:
    """Return (H, W, 3), the colours of what the rays of a camera meet first from in front."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(mesh.points_m), o3d.core.Tensor(mesh.triangles.astype(np.uint32))
    )
    rays = scene.create_rays_pinhole(_OPENING_DEG, at_m, eye_m, up, _WIDTH_PX, _HEIGHT_PX)
    rays = rays.numpy().reshape(-1, 6)
    rays[:, 3:] /= np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    picture = np.full((len(rays), 3), _PAPER, np.uint8)
    left = np.arange(len(rays))
    for _ in range(_BACKS):
        hits = {name: hit.numpy() for name, hit in scene.cast_rays(rays[left]).items()}
        facing = -(hits["primitive_normals"] * rays[left, 3:]).sum(axis=1)
        is_hit = np.isfinite(hits["t_hit"])
        front, back = is_hit & (facing > 0.0), is_hit & (facing <= 0.0)
        colours = _colours(mesh, hits["primitive_ids"][front], hits["primitive_uvs"][front])
        light = _DARKEST + (1.0 - _DARKEST) * facing[front, None]
        picture[left[front]] = np.rint(colours * light).clip(0.0, 255.0)
        past_m = (1.0 + _BEHIND) * hits["t_hit"][back, None]
        left = left[back]
        rays[left, :3] += past_m * rays[left, 3:]
        if not len(left):
            break
    return picture.reshape(_HEIGHT_PX, _WIDTH_PX, 3)


def _colours(
    mesh: Mesh, numbers: NDArray[np.uint32], at: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return (N, 3) colours of the surface, at (N, 2) barycentric places in its triangles."""
    corners = mesh.colours[mesh.triangles[numbers]].astype(np.float64)
    shares = np.column_stack([1.0 - at.sum(axis=1), at])
    return np.asarray((corners * shares[:, :, None]).sum(axis=1))

# SPDX-License-Identifier: Apache-2.0
"""The fused point cloud of the corrected keyframes: drift that is left shows as doubled walls."""

from pathlib import Path

import numpy as np
import open3d as o3d

from placerec.files import write_atomically
from slam.config import MapConfig
from slam.geometry.features import back_project, undistort
from slam.result import SlamResult
from slam.types import PREVIEW_SCALE, Camera, FloatArray, Keyframe

_STRIDE = 2  # every other preview pixel is dense enough at voxels of a centimetre


def fuse(result: SlamResult, config: MapConfig) -> o3d.geometry.PointCloud:
    """Return one coloured cloud, metres, world frame: the mean of the points in each voxel."""
    rays_px = _undistorted_grid(result.camera, result.keyframes[0].preview.depth_m.shape)
    fused = o3d.geometry.PointCloud()
    for keyframe, T_world_cam in zip(result.keyframes, result.T_world_kf, strict=True):
        if np.isnan(T_world_cam).any():  # in a part of the map that was not joined
            continue
        cloud = _cloud(keyframe, rays_px, result.camera, config.max_depth_m)
        # Thinned one by one first: the cloud in memory stays as small as the map.
        fused += cloud.voxel_down_sample(config.voxel_m).transform(T_world_cam)
    return fused.voxel_down_sample(config.voxel_m)


def write_map(path: Path, result: SlamResult, config: MapConfig) -> None:
    """Write the fused cloud as a binary PLY file.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    cloud = fuse(result, config)
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    vertex = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    vertex += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    rows = np.empty(len(points), dtype=vertex)
    for name, column in zip("xyz", points.T, strict=True):
        rows[name] = column
    for name, column in zip(("red", "green", "blue"), np.rint(colors.T * 255), strict=True):
        rows[name] = column
    types = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {types[kind]} {name}\n" for name, kind in vertex)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}"
    write_atomically(path, header.encode() + b"end_header\n" + rows.tobytes())


def _undistorted_grid(camera: Camera, preview_shape: tuple[int, ...]) -> FloatArray:
    height, width = preview_shape
    v, u = np.mgrid[0:height:_STRIDE, 0:width:_STRIDE].reshape(2, -1) / PREVIEW_SCALE
    return undistort(np.column_stack([u, v]).astype(np.float64), camera)


def _cloud(
    keyframe: Keyframe, pixels: FloatArray, camera: Camera, max_depth_m: float
) -> o3d.geometry.PointCloud:
    depth_m = keyframe.preview.depth_m[::_STRIDE, ::_STRIDE].ravel().astype(np.float64)
    rgb = keyframe.preview.rgb[::_STRIDE, ::_STRIDE].reshape(-1, 3)
    seen = (depth_m > 0.0) & (depth_m <= max_depth_m)
    cloud = o3d.geometry.PointCloud()
    points_m = back_project(pixels[seen], depth_m[seen], camera)
    cloud.points = o3d.utility.Vector3dVector(points_m)
    cloud.colors = o3d.utility.Vector3dVector(rgb[seen] / 255.0)
    return cloud

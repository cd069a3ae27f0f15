# SPDX-License-Identifier: Apache-2.0
"""The fused point cloud of the corrected keyframes: drift that is left shows as doubled walls."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from placerec.files import write_atomically
from slam.config import MapConfig
from slam.geometry import se3
from slam.geometry.features import back_project, undistort
from slam.result import SlamResult
from slam.types import PREVIEW_SCALE, FloatArray

_STRIDE = 2  # every other preview pixel is dense enough for the usual voxels
# A room seen from 1.5 m away is merged by the centimetre, and nothing further than 4 m is in it.
_VOXEL, _MAX_DEPTH = 1.0 / 150.0, 2.5  # of the median depth


@dataclass(frozen=True)
class PointCloud:
    """Points in space with (N, 3) colours, red, green, blue, 0 to 255.

    open3d would do the same, but to load it takes longer than all there is to do.
    """

    points_m: FloatArray  # (N, 3)
    colours: FloatArray

    def thinned(self, voxel_m: float) -> "PointCloud":
        """Return the means of the points and colours in each voxel."""
        voxels = np.floor(self.points_m / voxel_m).astype(np.int64)
        order = np.lexsort(voxels.T)
        is_first = np.ones(len(order), dtype=bool)
        is_first[1:] = (np.diff(voxels[order], axis=0) != 0).any(axis=1)
        starts = np.flatnonzero(is_first)
        counts = np.diff([*starts, len(order)])[:, None]
        columns = np.column_stack([self.points_m, self.colours])[order]
        means = np.add.reduceat(columns, starts) / counts if len(order) else columns
        return PointCloud(means[:, :3], means[:, 3:])

    @staticmethod
    def joined(clouds: Sequence["PointCloud"]) -> "PointCloud":
        """Return all of them as one."""
        empty = np.zeros((0, 3))
        return PointCloud(
            np.concatenate([empty, *(each.points_m for each in clouds)]),
            np.concatenate([empty, *(each.colours for each in clouds)]),
        )


def fuse(result: SlamResult, config: MapConfig) -> PointCloud:
    """Return one coloured cloud, metres, world frame: the mean of the points in each voxel."""
    height, width = result.keyframes[0].preview.depth_m.shape
    v, u = np.mgrid[0:height:_STRIDE, 0:width:_STRIDE].reshape(2, -1) / PREVIEW_SCALE
    pixels = undistort(np.column_stack([u, v]).astype(np.float64), result.camera)
    usual_m = _median_depth_m(result)
    voxel_m = _VOXEL * usual_m if config.voxel_m is None else config.voxel_m
    max_depth_m = _MAX_DEPTH * usual_m if config.max_depth_m is None else config.max_depth_m
    clouds = []
    for keyframe, T_world_cam in zip(result.keyframes, result.T_world_kf, strict=True):
        if np.isnan(T_world_cam).any():  # in a part of the map that was not joined
            continue
        depth_m = keyframe.preview.depth_m[::_STRIDE, ::_STRIDE].ravel().astype(np.float64)
        rgb = keyframe.preview.rgb[::_STRIDE, ::_STRIDE].reshape(-1, 3)
        seen = (depth_m > 0.0) & (depth_m <= max_depth_m)
        points_m = back_project(pixels[seen], depth_m[seen], result.camera)
        # Thinned one by one first: the clouds in memory stay as small as the map.
        cloud = PointCloud(points_m, rgb[seen].astype(np.float64)).thinned(voxel_m)
        clouds.append(PointCloud(se3.transform(T_world_cam, cloud.points_m), cloud.colours))
    return PointCloud.joined(clouds).thinned(voxel_m)


def _median_depth_m(result: SlamResult) -> float:
    seen = np.concatenate([each.preview.depth_m[::8, ::8].ravel() for each in result.keyframes])
    seen = seen[seen > 0.0]
    return float(np.median(seen)) if len(seen) else 1.0


def write_map(path: Path, result: SlamResult, config: MapConfig) -> None:
    """Write the fused cloud as a binary PLY file.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    cloud = fuse(result, config)
    columns = [*cloud.points_m.T, *np.rint(cloud.colours.T)]
    types = {**dict.fromkeys("xyz", "<f4"), **dict.fromkeys(("red", "green", "blue"), "u1")}
    vertices = np.rec.fromarrays(columns, dtype=list(types.items()))
    words = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {words[kind]} {name}\n" for name, kind in types.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}"
    write_atomically(path, header.encode() + b"end_header\n" + vertices.tobytes())

# SPDX-License-Identifier: Apache-2.0
"""The fused point cloud of the corrected keyframes: drift that is left shows as doubled walls."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.files import write_atomically
from slam.config import MapConfig
from slam.geometry import se3
from slam.geometry.features import back_project, undistort
from slam.result import SlamResult
from slam.types import PREVIEW_SCALE, FloatArray, IntArray

_STRIDE = 2  # every other preview pixel is dense enough for the usual voxels
# A room seen from 1.5 m away is merged by the centimetre, and nothing further than 4 m is in it.
_VOXEL, _MAX_DEPTH = 1.0 / 150.0, 2.5  # of the median depth
_FEW = 100_000  # points, which are not worth being thinned
_LARGEST = 1 << 62  # number that surely fits into 64 bits


@dataclass(frozen=True)
class PointCloud:
    """Points in space with (N, 3) colours, red, green, blue, 0 to 255.

    open3d would do the same, but to load it takes longer than all there is to do.
    """

    points_m: FloatArray  # (N, 3)
    colours: NDArray[np.floating[Any]]
    counts: NDArray[np.float32] | None = None  # (N,), of how many each is the mean; None: of itself

    def thinned(self, voxel_m: float) -> "PointCloud":
        """Return the means of the points and colours in each voxel."""
        order, starts = _voxel_by_voxel(self.points_m, voxel_m)
        ones = np.ones(len(order), np.float32)
        counts = (ones if self.counts is None else self.counts)[order]
        if len(order) == 0:
            return PointCloud(self.points_m, self.colours, counts)
        total = np.add.reduceat(counts, starts)

        def means(values: NDArray[Any]) -> NDArray[Any]:
            result = np.empty((len(starts), 3), values.dtype)
            for i in range(3):  # all at once would take three times the memory
                column = values[:, i].astype(np.float64)[order] * counts
                np.divide(np.add.reduceat(column, starts), total, out=result[:, i])
            return result

        return PointCloud(means(self.points_m), means(self.colours), total)

    @staticmethod
    def joined(clouds: Sequence["PointCloud"]) -> "PointCloud":
        """Return all of them, of which each was thinned, as one."""
        counts = [each.counts for each in clouds if each.counts is not None]
        return PointCloud(
            np.concatenate([np.zeros((0, 3)), *(each.points_m for each in clouds)]),
            np.concatenate([np.zeros((0, 3), np.float32), *(each.colours for each in clouds)]),
            np.concatenate([np.zeros(0, np.float32), *counts]),
        )


def _voxel_by_voxel(points_m: FloatArray, voxel_m: float) -> tuple[IntArray, IntArray]:
    """Return in which order points lie voxel by voxel, and where in it each voxel begins."""
    if len(points_m) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    voxels = [np.floor(points_m[:, i] / voxel_m).astype(np.int64) for i in (2, 1, 0)]
    spans = [int(np.ptp(axis)) + 1 for axis in voxels]
    if math.prod(spans) < _LARGEST:  # one number tells all of it, and is sorted in a third of time
        number = voxels.pop(0)
        number -= number.min()
        for span in spans[1:]:
            axis = voxels.pop(0)
            number *= span
            number += axis - axis.min()
        voxels = [number]
    order = np.lexsort(voxels[::-1])
    is_first = np.ones(len(order), dtype=bool)
    is_first[1:] = np.any([np.diff(axis[order]) != 0 for axis in voxels], axis=0)
    return order, np.flatnonzero(is_first)


def fuse(result: SlamResult, config: MapConfig) -> PointCloud:
    """Return one coloured cloud, metres, world frame: the mean of the points in each voxel."""
    height, width = result.keyframes[0].preview.depth_m.shape
    v, u = np.mgrid[0:height:_STRIDE, 0:width:_STRIDE].reshape(2, -1) / PREVIEW_SCALE
    pixels = undistort(np.column_stack([u, v]).astype(np.float64), result.camera)
    usual_m = _median_depth_m(result)
    voxel_m = _VOXEL * usual_m if config.voxel_m is None else config.voxel_m
    max_depth_m = _MAX_DEPTH * usual_m if config.max_depth_m is None else config.max_depth_m
    clouds = list[PointCloud]()  # the first is all until then
    for keyframe, T_world_cam in zip(result.keyframes, result.T_world_kf, strict=True):
        if np.isnan(T_world_cam).any():  # in a part of the map that was not joined
            continue
        shown = keyframe.preview
        depth_m = shown.depth_m[::_STRIDE, ::_STRIDE].ravel().astype(np.float64)
        rgb = shown.rgb[::_STRIDE, ::_STRIDE].reshape(-1, 3)
        seen = (depth_m > 0.0) & (depth_m <= max_depth_m)
        points_m = back_project(pixels[seen], depth_m[seen], result.camera)
        cloud = PointCloud(points_m, rgb[seen].astype(np.float32)).thinned(voxel_m)
        # In the world each counts once, of however many it is the mean.
        counts = np.ones(len(cloud.points_m), np.float32)
        points_m = se3.transform(T_world_cam, cloud.points_m)
        clouds.append(PointCloud(points_m, cloud.colours, counts))
        # Memory stays as small as the map, which yet is gone through few times.
        if sum(len(each.points_m) for each in clouds[1:]) > max(len(clouds[0].points_m) // 2, _FEW):
            clouds = [PointCloud.joined(clouds)]
            clouds = [clouds[0].thinned(voxel_m)]
    clouds = [PointCloud.joined(clouds)]
    return clouds[0].thinned(voxel_m)


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

# SPDX-License-Identifier: Apache-2.0
"""The fused point cloud of the corrected keyframes: drift that is left shows as doubled walls."""

from collections.abc import Iterator
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
from slam.types import PREVIEW_SCALE, FloatArray

_STRIDE = 2  # every other preview pixel is dense enough for the usual voxels
# A room seen from 1.5 m away is merged by the centimetre, and nothing further than 4 m is in it.
_VOXEL, _MAX_DEPTH = 1.0 / 150.0, 2.5  # of the median depth
_FEW = 100_000  # numbers, which are not worth being sorted
# What a step to the next voxel along each axis adds to a voxel's number, which wraps around.
_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


@dataclass(frozen=True)
class PointCloud:
    """Points in space with (N, 3) colours, red, green, blue, 0 to 255.

    open3d would do the same, but to load it takes longer than all there is to do.
    """

    points_m: FloatArray  # (N, 3)
    colours: NDArray[np.floating[Any]]

    def thinned(self, voxel_m: float) -> "PointCloud":
        """Return the means of the points and colours in each voxel."""
        if len(self.points_m) == 0:
            return self
        numbers = _voxel_numbers(self.points_m, voxel_m)
        means = _Means(np.unique(numbers))
        means.add(numbers, self)
        return means.cloud()


def _voxel_numbers(points_m: FloatArray, voxel_m: float) -> NDArray[np.uint64]:
    """Return (N,) numbers that tell voxels apart, but for one in 10^8 of all maps."""
    voxels = np.floor(points_m / voxel_m).astype(np.int64).view(np.uint64)
    return np.asarray(voxels[:, 0] * _ODD[0] + voxels[:, 1] * _ODD[1] + voxels[:, 2] * _ODD[2])


class _Means:
    """The means of points and colours in the voxels with (N,) numbers, in increasing order."""

    def __init__(self, numbers: NDArray[np.uint64]) -> None:
        self._numbers = numbers
        self._points_m = np.zeros((3, len(numbers)))
        self._colours = np.zeros((3, len(numbers)), np.float32)
        self._counts = np.zeros(len(numbers), np.float32)

    def add(self, numbers: NDArray[np.uint64], cloud: PointCloud) -> None:
        """Add a cloud's points, which are in the voxels with (M,) numbers."""
        place = np.searchsorted(self._numbers, numbers)
        np.add.at(self._counts, place, np.float32(1.0))
        for i in range(3):
            np.add.at(self._points_m[i], place, cloud.points_m[:, i])
            np.add.at(self._colours[i], place, cloud.colours[:, i].astype(np.float32))

    def cloud(self) -> PointCloud:
        """Return the means; nothing can be added any more."""
        self._points_m /= self._counts
        self._colours /= self._counts
        return PointCloud(self._points_m.T, self._colours.T)


def fuse(result: SlamResult, config: MapConfig) -> PointCloud:
    """Return one coloured cloud, metres, world frame: the mean of the points in each voxel."""
    usual_m = _median_depth_m(result)
    voxel_m = _VOXEL * usual_m if config.voxel_m is None else config.voxel_m
    max_depth_m = _MAX_DEPTH * usual_m if config.max_depth_m is None else config.max_depth_m
    # Twice through the keyframes, so that not much more than the map is ever in memory.
    numbers, more = np.zeros(0, np.uint64), list[NDArray[np.uint64]]()
    for cloud in _clouds(result, voxel_m, max_depth_m):
        more.append(_voxel_numbers(cloud.points_m, voxel_m))
        if sum(map(len, more)) > max(len(numbers) // 2, _FEW):
            numbers, more = np.unique(np.concatenate([numbers, *more])), []
    means = _Means(np.unique(np.concatenate([numbers, *more])))
    for cloud in _clouds(result, voxel_m, max_depth_m):
        means.add(_voxel_numbers(cloud.points_m, voxel_m), cloud)
    return means.cloud()


def _clouds(result: SlamResult, voxel_m: float, max_depth_m: float) -> Iterator[PointCloud]:
    """Yield what each keyframe saw, in the world, thinned first."""
    height, width = result.keyframes[0].preview.depth_m.shape
    v, u = np.mgrid[0:height:_STRIDE, 0:width:_STRIDE].reshape(2, -1) / PREVIEW_SCALE
    pixels = undistort(np.column_stack([u, v]).astype(np.float64), result.camera)
    for keyframe, T_world_cam in zip(result.keyframes, result.T_world_kf, strict=True):
        if np.isnan(T_world_cam).any():  # in a part of the map that was not joined
            continue
        shown = keyframe.preview
        depth_m = shown.depth_m[::_STRIDE, ::_STRIDE].ravel().astype(np.float64)
        rgb = shown.rgb[::_STRIDE, ::_STRIDE].reshape(-1, 3)
        seen = (depth_m > 0.0) & (depth_m <= max_depth_m)
        points_m = back_project(pixels[seen], depth_m[seen], result.camera)
        cloud = PointCloud(points_m, rgb[seen].astype(np.float32)).thinned(voxel_m)
        yield PointCloud(se3.transform(T_world_cam, cloud.points_m), cloud.colours)


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
    types = {**dict.fromkeys("xyz", "<f4"), **dict.fromkeys(("red", "green", "blue"), "u1")}
    vertices = np.empty(len(cloud.points_m), list(types.items()))
    for i, name in enumerate(types):
        vertices[name] = cloud.points_m[:, i] if i < 3 else np.rint(cloud.colours[:, i - 3])
    del cloud
    words = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {words[kind]} {name}\n" for name, kind in types.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}"
    write_atomically(path, header.encode() + b"end_header\n" + vertices.tobytes())

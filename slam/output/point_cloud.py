# SPDX-License-Identifier: Apache-2.0
"""The fused point cloud of the corrected keyframes: drift that is left shows as doubled walls."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.files import write_atomically
from slam.config import MapConfig
from slam.geometry import se3
from slam.geometry.features import back_project, undistort
from slam.geometry.voxels import add_to_voxels, hash_table, voxel_numbers
from slam.result import SlamResult
from slam.types import PREVIEW_SCALE, Camera, FloatArray

_STRIDE = 2  # every other preview pixel is dense enough for the usual voxels
# A room seen from 1.5 m away is merged by the centimetre, and nothing further than 4 m is in it.
_VOXEL, _MAX_DEPTH = 1.0 / 150.0, 2.5  # of the median depth
# For the voxels of a map, to begin with. What is large takes up memory only as it is filled, and
# grows without being copied; what was small at first would leave all it grew out of.
_ROOM = 600_000


@dataclass(frozen=True)
class PointCloud:
    """Points in space with (N, 3) colours, red, green, blue, 0 to 255.

    open3d would do the same, but to load it takes longer than all there is to do.
    """

    points_m: FloatArray  # (N, 3)
    colours: NDArray[np.float32]

    def thinned(self, voxel_m: float) -> "PointCloud":
        """Return the means of the points and colours in each voxel."""
        means = VoxelMeans(voxel_m, len(self.points_m))
        means.add(self)
        return means.cloud()


class VoxelMeans:
    """The means of points and colours in voxels, which a hash table finds, however many come."""

    def __init__(self, voxel_m: float, room: int = _ROOM) -> None:
        """Begin with room for so many."""
        self._voxel_m = voxel_m
        self._count = 0
        self._numbers = np.zeros(room, np.uint64)
        self._sums_m = np.zeros((room, 3))
        self._sums = np.zeros((room, 4), np.float32)  # of colours, and how many
        self._table = hash_table(self._numbers[:0], 0)  # grows as they come: all of it is used

    def add(self, cloud: PointCloud) -> None:
        """Add a cloud's points."""
        self._make_room(self._count + len(cloud.points_m))
        points_m = np.ascontiguousarray(cloud.points_m)
        numbers = voxel_numbers(points_m, self._voxel_m)
        each = np.column_stack([cloud.colours, np.ones(len(numbers), np.float32)])
        kept = (self._table, self._numbers, self._sums_m, self._sums)
        self._count = add_to_voxels(numbers, points_m, each, *kept, self._count)

    def _make_room(self, most: int) -> None:
        if most > len(self._numbers):
            room = most + most // 8
            self._numbers.resize(room)  # in place, where the system has room behind it
            self._sums_m.resize((room, 3))
            self._sums.resize((room, 4))
        if 2 * most > len(self._table):
            del self._table  # so that there are never two
            self._table = hash_table(self._numbers[: self._count], most)

    def cloud(self) -> PointCloud:
        """Return the means, in the order of the first points; nothing can be added any more."""
        points_m, sums = self._sums_m[: self._count], self._sums[: self._count]
        count = sums[:, 3:]
        points_m /= count
        sums[:, :3] /= count
        return PointCloud(points_m, sums[:, :3])


def sizes(result: SlamResult, config: MapConfig) -> tuple[float, float]:
    """Return the edge of the voxels and the depth beyond which nothing is fused, metres."""
    usual_m = _median_depth_m(result)
    voxel_m = _VOXEL * usual_m if config.voxel_m is None else config.voxel_m
    max_depth_m = _MAX_DEPTH * usual_m if config.max_depth_m is None else config.max_depth_m
    return voxel_m, max_depth_m


def fuse(result: SlamResult, config: MapConfig) -> PointCloud:
    """Return one coloured cloud, metres, world frame: the mean of the points in each voxel."""
    voxel_m, max_depth_m = sizes(result, config)
    means = VoxelMeans(voxel_m)
    for cloud in _clouds(result, voxel_m, max_depth_m):
        means.add(cloud)
    return means.cloud()


def _clouds(result: SlamResult, voxel_m: float, max_depth_m: float) -> Iterator[PointCloud]:
    """Yield what each keyframe saw, in the world, thinned first."""
    pixels_of: dict[Camera, FloatArray] = {}  # that of the run, and those of an earlier map
    for keyframe, T_world_cam in zip(result.keyframes, result.T_world_kf, strict=True):
        if np.isnan(T_world_cam).any():  # in a part of the map that was not joined
            continue
        shown, camera = keyframe.preview, keyframe.camera or result.camera
        image_m = shown.depth_m
        if camera not in pixels_of:
            pixels_of[camera] = _pixels(camera, image_m.shape)
        pixels = pixels_of[camera]
        depth_m = image_m[::_STRIDE, ::_STRIDE].ravel().astype(np.float64)
        rgb = shown.rgb[::_STRIDE, ::_STRIDE].reshape(-1, 3)
        seen = (depth_m > 0.0) & (depth_m <= max_depth_m)
        points_m = back_project(pixels[seen], depth_m[seen], camera)
        cloud = PointCloud(points_m, rgb[seen].astype(np.float32)).thinned(voxel_m)
        yield PointCloud(se3.transform(T_world_cam, cloud.points_m), cloud.colours)


def _pixels(camera: Camera, shape: tuple[int, ...]) -> FloatArray:
    """Return (N, 2) undistorted pixels of a camera, those whose depth in its preview is taken."""
    v, u = np.mgrid[0 : shape[0] : _STRIDE, 0 : shape[1] : _STRIDE].reshape(2, -1) / PREVIEW_SCALE
    return undistort(np.column_stack([u, v]).astype(np.float64), camera)


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

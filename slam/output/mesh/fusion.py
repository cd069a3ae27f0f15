# SPDX-License-Identifier: Apache-2.0
"""Surfaces of depth images: a truncated signed distance function in voxels, by Open3D."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from placerec.files import write_atomically
from slam.geometry import se3
from slam.types import FloatArray

_TRUNCATION = 4.0
"""Voxels: walls further apart stay two."""
_BLOCK, _ROOM = 8, 4000  # voxels along the edge of a block; blocks to begin with
_SEEN = 1.5  # images at least, of each voxel: what one alone has seen is mostly noise


@dataclass(frozen=True)
class Mesh:
    """A surface.

    Attributes:
        points_m: (N, 3) float32, its corners, in the world's frame.
        colours: (N, 3) uint8, of the corners, red, green, blue.
        triangles: (T, 3) int32, rows of corners, counter-clockwise as seen from in front.
    """

    points_m: NDArray[np.float32]
    colours: NDArray[np.uint8]
    triangles: NDArray[np.int32]


class Fusion:
    """Depth images of one pinhole camera, added up."""

    def __init__(self, pinhole: FloatArray, voxel_m: float, max_depth_m: float) -> None:
        """Begin; the camera is fx, fy, cx, cy."""
        core = o3d.core
        fx, fy, cx, cy = pinhole
        self._intrinsics = core.Tensor(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
        self._max_depth_m = float(max_depth_m)
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.uint16, core.uint16),
            ((1,), (1,), (3,)),
            voxel_m,
            _BLOCK,
            _ROOM,
        )

    def add(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], T_world_cam: FloatArray
    ) -> None:
        """Add an image, its depth being zero where unknown."""
        if not ((depth_m > 0.0) & (depth_m <= self._max_depth_m)).any():
            return  # which Open3D makes an error of
        depth = o3d.t.geometry.Image(depth_m)
        colour = o3d.t.geometry.Image(rgb.astype(np.float32))  # both alike
        T_cam_world = o3d.core.Tensor(se3.inverse(T_world_cam))
        how = (T_cam_world, 1.0, self._max_depth_m, _TRUNCATION)
        blocks = self._grid.compute_unique_block_coordinates(depth, self._intrinsics, *how)
        self._grid.integrate(blocks, depth, colour, self._intrinsics, self._intrinsics, *how)

    def mesh(self) -> Mesh:
        """Return the surface, the same for the same images, whatever the order of threads."""
        if self._grid.hashmap().size():
            found = self._grid.extract_triangle_mesh(weight_threshold=_SEEN)
            if len(found.vertex.positions) and len(found.triangle.indices):
                return _in_order(found)
        corners, colours = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        return Mesh(corners, colours, np.zeros((0, 3), np.int32))


def _in_order(found: Any) -> Mesh:
    """Return an Open3D mesh with corners and triangles in the order of space."""
    points_m, triangles = found.vertex.positions.numpy(), found.triangle.indices.numpy()
    colours = np.rint(found.vertex.colors.numpy()).clip(0, 255).astype(np.uint8)
    order = np.lexsort((*colours.T, *points_m.T))
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    triangles = place[triangles]
    first = triangles.argmin(axis=1)[:, None]  # turned, which leaves its front where it is
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    return Mesh(points_m[order], colours[order], triangles)


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY file.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    corners = np.empty(len(mesh.points_m), [("at", "<f4", 3), ("colour", "u1", 3)])
    corners["at"], corners["colour"] = mesh.points_m, mesh.colours
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.triangles
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n{axes}{colours}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    write_atomically(path, header.encode() + corners.tobytes() + faces.tobytes())

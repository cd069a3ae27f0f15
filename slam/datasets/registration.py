# SPDX-License-Identifier: Apache-2.0
"""Colour and depth images of two cameras, made into images of one: pixel by pixel."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.types import Camera, FloatArray

_SAME_PX = 0.5


@dataclass(frozen=True, eq=False)
class Registration:
    """How a recording's colour and depth images belong together.

    Attributes:
        color_camera: made the colour images; its lens does not distort.
        depth_camera: made the depth images; its lens does not distort.
        T_color_depth: (4, 4), from the depth camera's frame to the colour camera's.
    """

    color_camera: Camera
    depth_camera: Camera
    T_color_depth: FloatArray

    @cached_property
    def camera(self) -> Camera:
        """The camera of the registered images: the colour camera at the depth images' size."""
        ours, depth = self.color_camera, self.depth_camera
        return replace(resized(ours, depth.width, depth.height), depth_scale=depth.depth_scale)

    def register_color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the (H, W, 3) colour image at the size of the depth images."""
        size = self.depth_camera.width, self.depth_camera.height
        if rgb.shape[1::-1] == size:
            return rgb
        return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def register_depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the (H, W) depth image, metres, as `camera` would have taken it, 0 where unknown.

        Of surfaces that fall into one pixel the nearest is seen.
        """
        if self._is_registered:
            return depth_m
        camera, t = self.camera, self.T_color_depth[:3, 3].astype(np.float32)
        rays = self._rays
        z = rays[2] * depth_m + t[2]
        known = (depth_m > 0.0) & (z > 0.0)
        z = z[known]
        u = (rays[0] * depth_m + t[0])[known] / z * np.float32(camera.fx) + np.float32(camera.cx)
        v = (rays[1] * depth_m + t[1])[known] / z * np.float32(camera.fy) + np.float32(camera.cy)
        column, row = np.rint(u).astype(np.int32), np.rint(v).astype(np.int32)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        nearest_m = np.full(camera.width * camera.height, np.inf, np.float32)
        np.minimum.at(nearest_m, (row * camera.width + column)[inside], z[inside])
        nearest_m[np.isinf(nearest_m)] = 0.0
        return nearest_m.reshape(camera.height, camera.width)

    @cached_property
    def _rays(self) -> NDArray[np.float32]:
        """(3, H, W) what the depth camera's pixels look along, depth 1, colour camera's axes."""
        eye = self.depth_camera
        v, u = np.indices((eye.height, eye.width))
        rays = [(u - eye.cx) / eye.fx, (v - eye.cy) / eye.fy, np.ones(u.shape)]
        return np.tensordot(self.T_color_depth[:3, :3], rays, axes=1).astype(np.float32)

    @cached_property
    def _is_registered(self) -> bool:
        """Whether no pixel of the depth images would move."""
        ours, theirs = self.camera, self.depth_camera
        corners = np.array([[-0.5, ours.width - 0.5], [-0.5, ours.height - 0.5]])
        moved = [
            (corners[0] - theirs.cx) / theirs.fx * ours.fx + ours.cx - corners[0],
            (corners[1] - theirs.cy) / theirs.fy * ours.fy + ours.cy - corners[1],
        ]
        is_one_place = np.array_equal(self.T_color_depth, np.eye(4))
        return is_one_place and bool(np.abs(moved).max() <= _SAME_PX)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the same images at another size."""
    along, down = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * along,
        fy=camera.fy * down,
        # A pixel's centre is at whole numbers, so that the image begins at -0.5.
        cx=(camera.cx + 0.5) * along - 0.5,
        cy=(camera.cy + 0.5) * down - 0.5,
    )

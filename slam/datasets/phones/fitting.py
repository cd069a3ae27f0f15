# SPDX-License-Identifier: Apache-2.0
"""Large colour and small depth images of one view, brought to one size between the two.

A phone's colour image has 1920x1440 pixels or so, its depth 256x192. At the size of depth, corners
are few and known to two fifths of the precision; at the size of colour, every step takes nine times
as long as on other recordings. Depth is made larger by the nearest pixel: a mean across an edge
would be a place where nothing is.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage
from slam.datasets.registration import resized
from slam.types import Camera, SlamError

_LONGER_SIDE_PX = 640
_SAME_ASPECT = 0.02


@dataclass(frozen=True, eq=False)
class Fitting:
    """How a recording's colour and depth images, which show the same, become frames.

    Attributes:
        color_camera: made the colour images.
    """

    color_camera: Camera

    @cached_property
    def camera(self) -> Camera:
        """The camera of the frames: the colour camera with no more than 640 pixels a side."""
        width, height = self.color_camera.width, self.color_camera.height
        share = min(1.0, _LONGER_SIDE_PX / max(width, height))
        return resized(self.color_camera, round(share * width), round(share * height))

    def fit_color(
        self, rgb: NDArray[np.uint8] | BrokenImage, path: Path
    ) -> NDArray[np.uint8] | BrokenImage:
        """Return the (H, W, 3) colour image at the size of the frames; a broken one as it is.

        Raises:
            SlamError: it is not of the colour camera's size.
        """
        if isinstance(rgb, BrokenImage):
            return rgb
        color = self.color_camera
        if rgb.shape[:2] != (color.height, color.width):
            raise SlamError(
                f"a colour image has {rgb.shape[1]}x{rgb.shape[0]} pixels but the camera"
                f" {color.width}x{color.height}; give the camera that made it with"
                f" --input.camera FILE.toml: {path}"
            )
        size = self.camera.width, self.camera.height
        if rgb.shape[1::-1] == size:
            return rgb
        return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def fit_depth(
        self, depth_m: NDArray[np.float32] | BrokenImage, path: Path
    ) -> NDArray[np.float32] | BrokenImage:
        """Return the (H, W) depth image, metres, at the size of the frames; a broken one as it is.

        Raises:
            SlamError: it does not have the shape of the colour images.
        """
        if isinstance(depth_m, BrokenImage):
            return depth_m
        color, (height, width) = self.color_camera, depth_m.shape
        if abs(width * color.height / (height * color.width) - 1.0) > _SAME_ASPECT:
            raise SlamError(
                f"a depth image has {width}x{height} pixels, which is not the shape of its colour"
                f" image of {color.width}x{color.height}: {path}"
            )
        size = self.camera.width, self.camera.height
        fitted = cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT)
        return np.asarray(fitted, dtype=np.float32)

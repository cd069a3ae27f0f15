# SPDX-License-Identifier: Apache-2.0
"""From an image of any size to the numbers that a network was trained with."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.errors import RecognizerError


@dataclass(frozen=True)
class Preprocessing:
    """Resize, then subtract a mean and divide by a scale.

    Attributes:
        width_px, height_px: what images are resized to, whatever their shape.
        mean, scale: per channel in the network's order, on pixel values from 0 to 255.
        is_bgr: whether the network takes blue first; callers always hand over RGB.
    """

    width_px: int
    height_px: int
    mean: tuple[float, float, float]
    scale: tuple[float, float, float]
    is_bgr: bool = False

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (3, height, width) float32 input made of a uint8 image.

        It is (H, W, 3) RGB, (H, W, 4) with alpha (ignored), or (H, W) or (H, W, 1) grey.

        Raises:
            RecognizerError: it is no such image.
        """
        rgb = _as_rgb(image)
        # Averaging when shrinking keeps fine texture from turning into noise; it cannot enlarge.
        is_smaller = rgb.shape[1] > self.width_px or rgb.shape[0] > self.height_px
        interpolation = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
        size = (self.width_px, self.height_px)
        resized = np.asarray(cv2.resize(rgb, size, interpolation=interpolation))
        channels = resized[..., ::-1] if self.is_bgr else resized
        mean, scale = np.asarray(self.mean, np.float32), np.asarray(self.scale, np.float32)
        values: NDArray[np.float32] = (channels.astype(np.float32) - mean) / scale
        return values.transpose(2, 0, 1)


TORCHVISION_INPUT = Preprocessing(
    width_px=224, height_px=224, mean=(123.675, 116.28, 103.53), scale=(58.395, 57.12, 57.375)
)
CAFFE_INPUT = Preprocessing(
    width_px=227, height_px=227, mean=(104.0, 117.0, 123.0), scale=(1.0, 1.0, 1.0), is_bgr=True
)
"""What networks trained with these on ImageNet take."""


def _as_rgb(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        seen = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise RecognizerError(f"an image must be a uint8 array, not {seen}")
    layers = image[..., None] if image.ndim == 2 else image
    if layers.ndim != 3 or layers.shape[2] not in (1, 3, 4) or layers.size == 0:
        raise RecognizerError(
            f"an image has shape {image.shape}; it must be (H, W, 3), or (H, W) grey, "
            "or (H, W, 4) with alpha"
        )
    if layers.shape[2] == 1:
        return np.repeat(layers, 3, axis=2)
    return np.ascontiguousarray(layers[..., :3])

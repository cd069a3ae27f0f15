# SPDX-License-Identifier: Apache-2.0
"""What a first-generation Kinect (structured light) makes of a perfect image.

The depth model takes the triangulation and its steps of 1/8 pixel of disparity from K. Khoshelham
and S. O. Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping applications",
Sensors 12 (2012); axial and lateral noise from C. V. Nguyen, S. Izadi and D. Lovell, "Modeling
Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012; and the smooth
distortion that every single device has from A. Teichman, S. Miller and S. Thrun, "Unsupervised
intrinsic calibration of depth sensors via SLAM", RSS 2013.
"""

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from slam.types import Camera

DISPARITY_STEPS_M = 351.0
"""Disparity of a surface at 1 m, in steps: 585 px focal length x 0.075 m baseline x 8 steps."""
_BASELINE_M = 0.075
_LOW_M, _HIGH_M = 0.5, 5.0
_MAX_INCIDENCE_DEG = 80.0
_JITTER_PX = 0.5  # lateral noise in an image of 525 px focal length

_DepthImage = NDArray[np.float32]


def add_kinect_noise(depth_m: _DepthImage, camera: Camera, rng: Generator) -> _DepthImage:
    """Return the depth that the sensor would report, 0 where it sees nothing.

    The exact depth is (H, W) float32, metres, 0 where there is no surface. The device's own
    distortion does not depend on `rng`.
    """
    blind = in_projector_shadow(depth_m, camera) | is_grazing(depth_m, camera)
    lit_m = np.where(blind, np.float32(0.0), depth_m)
    # Edges are ragged: each pixel is taken from a little way off.
    u, v = _JITTER_PX * camera.fx / 525.0 * rng.standard_normal((2, *lit_m.shape), np.float32)
    u += np.arange(camera.width, dtype=np.float32)
    v += np.arange(camera.height, dtype=np.float32)[:, None]
    moved_m = cv2.remap(lit_m, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    seen_m = moved_m * (1.0 + depth_bias(camera))
    sigma_m = 0.0012 + 0.0019 * (seen_m - 0.4) ** 2
    seen_m += sigma_m * rng.standard_normal(seen_m.shape, np.float32)
    steps = np.rint(DISPARITY_STEPS_M / np.clip(seen_m, _LOW_M, _HIGH_M))
    in_range = (seen_m > _LOW_M) & (seen_m < _HIGH_M)
    return np.where(in_range, DISPARITY_STEPS_M / steps, 0.0).astype(np.float32)


def depth_bias(camera: Camera) -> _DepthImage:
    """Return (H, W) relative depth error of this device: smooth, fixed, -0.1 to 0.9 percent."""
    x = np.linspace(-1.0, 1.0, camera.width, dtype=np.float32)[None, :]
    y = np.linspace(-1.0, 1.0, camera.height, dtype=np.float32)[:, None]
    waves = 0.6 * np.sin(2.2 * x + 0.6) + 0.4 * np.cos(2.6 * y - 1.9 * x)
    return np.asarray(0.004 + 0.005 * waves, np.float32)


def in_projector_shadow(depth_m: _DepthImage, camera: Camera) -> NDArray[np.bool_]:
    """Return (H, W) where something nearer keeps the projector's light away: left of edges.

    The projector stands to the right of the camera and sees column u at u - f b / z. Where a pixel
    further right lies further left for the projector, it covers this one.
    """
    u = np.arange(camera.width, dtype=np.float32)
    seen_u = u - camera.fx * _BASELINE_M / np.where(depth_m > 0.0, depth_m, np.inf)
    leftmost = np.minimum.accumulate(seen_u[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(seen_u > leftmost)


def is_grazing(depth_m: _DepthImage, camera: Camera) -> NDArray[np.bool_]:
    """Return (H, W) where a surface is seen too flat to send light back, depth edges included."""
    x = ((np.arange(camera.width, dtype=np.float32) - camera.cx) / camera.fx)[None, :]
    y = ((np.arange(camera.height, dtype=np.float32) - camera.cy) / camera.fy)[:, None]
    # The plane n . (x, y, 1) z = z through a pixel and its slopes give n up to its length.
    n_x = -camera.fx * cv2.Sobel(depth_m, cv2.CV_32F, 1, 0, scale=0.125)
    n_y = -camera.fy * cv2.Sobel(depth_m, cv2.CV_32F, 0, 1, scale=0.125)
    n_z = depth_m - x * n_x - y * n_y
    lengths = np.sqrt((n_x**2 + n_y**2 + n_z**2) * (x**2 + y**2 + 1.0))
    return np.asarray(depth_m < np.cos(np.radians(_MAX_INCIDENCE_DEG)) * lengths)


def add_colour_noise(rgb: NDArray[np.uint8], rng: Generator) -> NDArray[np.uint8]:
    """Return a (H, W, 3) uint8 image as a cheap lens and chip take it: soft, vignetted, grainy."""
    height, width = rgb.shape[:2]
    x = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None, :, None]
    y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None, None]
    soft = cv2.GaussianBlur(rgb, (0, 0), 0.6) * (1.0 - 0.13 * (x**2 + y**2))
    grain = 2.0 * rng.standard_normal(rgb.shape, np.float32)
    return np.asarray(np.clip(soft + grain + 0.5, 0.0, 255.0), np.uint8)

# SPDX-License-Identifier: Apache-2.0
"""What an RGB-D camera measures of a point, and how well.

A view measures pixel u, pixel v and disparity `baseline * fx / depth`: depth becomes what a second,
virtual camera measures, in which the noise of a structured-light camera is the same near and far.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import PYRAMID_SCALE
from slam.types import Camera, Features, FloatArray

_PIXEL_SIGMA_PX = 1.0  # on the finest pyramid level
_COARSENESS = PYRAMID_SCALE ** np.arange(16.0)  # by pyramid level
_BASELINE_M = 0.075  # of the Kinect
# A feature's depth is this many times less certain than the sensor's: it is read at an edge more
# often than not, and the two images are not of one instant. The coarser the feature, the further
# off may be where it is read; this is on the finest pyramid level: 25 mm at 1 m, 10 cm at 2 m, for
# a Kinect.
_AT_EDGES = 10.0

LIMIT = 5.991**0.5
"""95 % of the pixels that are what they claim are closer, whitened: chi-square of two."""
HUBER = 1.345
"""Whitened length from which a pixel's pull stops growing."""
CAUCHY = 1.0
"""Whitened error from which a depth's pull fades: it may be that of a neighbour."""

Intrinsics = tuple[float, float, float, float, float]


def intrinsics(camera: Camera) -> Intrinsics:
    """Return fx, fy, cx, cy and what a disparity is by 1 / depth, as compiled loops take them."""
    # Numbers of another kind, such as whole ones, would be compiled for anew.
    return (*pinhole(camera), float(_BASELINE_M * camera.fx))


def pinhole(camera: Camera) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy, pixels."""
    return (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))


@dataclass(frozen=True)
class Observations:
    """M points as one or several cameras saw them.

    Attributes:
        seen: (M, 3) float64, u px, v px, disparity px; the disparity is NaN where unknown.
        sigma: (M, 3) float64, px, their standard deviations.
    """

    seen: FloatArray
    sigma: FloatArray

    @staticmethod
    def of(features: Features, index: NDArray[np.int64], camera: Camera) -> "Observations":
        """Collect what was measured of the features with (M,) indices."""
        disparity_px = _BASELINE_M * camera.fx / features.depth_m[index].astype(np.float64)
        coarseness = _COARSENESS[features.octaves[index]]
        pixel_sigma = _PIXEL_SIGMA_PX * coarseness
        inverse_depth_sigma = _AT_EDGES * camera.depth_noise_m  # 1/m
        disparity_sigma = inverse_depth_sigma * _BASELINE_M * camera.fx * coarseness
        return Observations(
            seen=np.column_stack([features.undistorted_px[index], disparity_px]),
            sigma=np.column_stack([pixel_sigma, pixel_sigma, disparity_sigma]),
        )

    def __len__(self) -> int:
        return len(self.seen)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Observations":
        """Keep some of the points, by an (M,) mask or by indices."""
        return Observations(self.seen[chosen], self.sigma[chosen])

    def seen_by(self, camera: Camera, other: Camera) -> "Observations":
        """Return what a camera saw as another one at its place would have, with the same errors.

        Whitened they are the same, so that one camera stands for many.
        """
        if camera is other or pinhole(camera) == pinhole(other):
            return self
        zoom = np.array([other.fx / camera.fx, other.fy / camera.fy, other.fx / camera.fx])
        centre, there = (np.array([each.cx, each.cy, 0.0]) for each in (camera, other))
        return Observations((self.seen - centre) * zoom + there, self.sigma * zoom)

    @staticmethod
    def joined(parts: Sequence["Observations"]) -> "Observations":
        """Return all of them as one."""
        seen = np.concatenate([part.seen for part in parts])
        return Observations(seen, np.concatenate([part.sigma for part in parts]))

    def residuals(self, points_cam_m: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals (M, 3), 0 where unknown, and their (M, 3, 3) derivatives.

        The (M, 3) points, metres, camera frame, are where what was seen should be.
        """
        expected, derivative = project(points_cam_m, camera)
        residuals = (expected - self.seen) / self.sigma
        derivative /= self.sigma[:, :, None]
        unknown = ~np.isfinite(residuals)
        residuals[unknown], derivative[unknown] = 0.0, 0.0
        return residuals, derivative

    def agree(self, points_cam_m: FloatArray, camera: Camera) -> NDArray[np.bool_]:
        """Return (M,) bool: which of (M, 3) points, camera frame, were seen where they are.

        Depth has no say in it: where it is wrong, the pixel may still be right.
        """
        residuals, _ = self.residuals(points_cam_m, camera)
        return np.asarray((_pixel_lengths(residuals) < LIMIT) & (points_cam_m[:, 2] > 0.0))


def robust_weights(residuals: FloatArray) -> FloatArray:
    """Return the weights (M, 3), 0 to 1, of (M, 3) whitened residuals.

    They make the squares grow as the robust costs do: Huber's of pixels, Cauchy's of depth.
    """
    weights = np.empty_like(residuals)
    pixel_weights = np.minimum(1.0, HUBER / np.maximum(_pixel_lengths(residuals), 1e-12))
    weights[:, :2] = pixel_weights[:, None]
    weights[:, 2] = 1.0 / (1.0 + (residuals[:, 2] / CAUCHY) ** 2)
    return weights


def _pixel_lengths(residuals: FloatArray) -> FloatArray:
    # What np.linalg.norm does, but it takes its time over short rows.
    return np.asarray(np.sqrt(residuals[:, 0] ** 2 + residuals[:, 1] ** 2))


def project(points_m: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return what the camera should measure of (M, 3) points in its frame, metres.

    That is (M, 3) u, v and disparity, pixels, and (M, 3, 3) its derivative by the point, px/m.
    """
    inverse_z = 1.0 / points_m[:, 2]
    x, y = points_m[:, 0] * inverse_z, points_m[:, 1] * inverse_z
    baseline_fx = _BASELINE_M * camera.fx
    seen = np.column_stack(
        [camera.fx * x + camera.cx, camera.fy * y + camera.cy, baseline_fx * inverse_z]
    )
    derivative = np.zeros((len(points_m), 3, 3))
    derivative[:, 0, 0] = camera.fx * inverse_z
    derivative[:, 0, 2] = -camera.fx * x * inverse_z
    derivative[:, 1, 1] = camera.fy * inverse_z
    derivative[:, 1, 2] = -camera.fy * y * inverse_z
    derivative[:, 2, 2] = -baseline_fx * inverse_z**2
    return seen, derivative

# SPDX-License-Identifier: Apache-2.0
"""Where points are that two views saw without measuring their depth."""

import numpy as np
from numpy.typing import NDArray

from slam.geometry import se3
from slam.geometry.features import back_project
from slam.geometry.reprojection import Observations
from slam.types import Camera, FloatArray

_MAX_DEPTH_SIGMA = 0.2  # relative to the depth: the rays meet at too small an angle for less


def triangulate(
    T_a_b: FloatArray, seen_by_a: Observations, seen_by_b: Observations, camera: Camera
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return (M, 3) points, metres, in a's frame, half way between two views' rays.

    The (M,) mask tells which to believe: they lie before both cameras, each sees them where it saw
    them, and the angle between the rays tells their depth.
    """
    rays_a, rays_b = _rays(seen_by_a, camera), _rays(seen_by_b, camera) @ T_a_b[:3, :3].T
    # s rays_a comes closest to t_a_b + t rays_b.
    baseline_m = T_a_b[:3, 3]
    aa, bb, ab = _dots(rays_a, rays_a), _dots(rays_b, rays_b), _dots(rays_a, rays_b)
    a_baseline, b_baseline = rays_a @ baseline_m, rays_b @ baseline_m
    sine_squared = np.maximum(1.0 - ab**2 / (aa * bb), 1e-12)
    determinant = aa * bb * sine_squared
    s = (bb * a_baseline - ab * b_baseline) / determinant
    t = (ab * a_baseline - aa * b_baseline) / determinant
    points_a_m = 0.5 * (s[:, None] * rays_a + baseline_m + t[:, None] * rays_b)
    points_b_m = se3.transform(se3.inverse(T_a_b), points_a_m)
    angle_sigma = np.hypot(seen_by_a.sigma[:, 0], seen_by_b.sigma[:, 0]) / camera.fx
    is_sound = (s > 0.0) & (t > 0.0) & (points_a_m[:, 2] > 0.0) & (points_b_m[:, 2] > 0.0)
    is_sound &= angle_sigma < _MAX_DEPTH_SIGMA * np.sqrt(sine_squared)
    is_sound[is_sound] &= seen_by_a.select(is_sound).agree(points_a_m[is_sound], camera)
    is_sound[is_sound] &= seen_by_b.select(is_sound).agree(points_b_m[is_sound], camera)
    return points_a_m, is_sound


def _rays(measured: Observations, camera: Camera) -> FloatArray:
    return back_project(measured.seen[:, :2], np.ones(len(measured)), camera)


def _dots(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("mi,mi->m", a, b))

# SPDX-License-Identifier: Apache-2.0
"""Robust least squares for the pose of one camera that sees known points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam import se3
from slam.measurement import Measurements, robust_weights
from slam.types import Camera, FloatArray

_ROUNDS = 3  # each decides anew who agrees
_STEPS = 4
_SMALL_STEP = 1e-5


@dataclass(frozen=True)
class RefinedPose:
    """A camera's pose and who agrees with it.

    Attributes:
        T_world_cam: (4, 4).
        hessian: (6, 6) of the robust cost, for a tangent on the right of T_world_cam.
        inlier_mask: (M,) bool.
    """

    T_world_cam: FloatArray
    hessian: FloatArray
    inlier_mask: NDArray[np.bool_]


def refine_pose(
    T_world_cam: FloatArray, points_m: FloatArray, measured: Measurements, camera: Camera
) -> RefinedPose:
    """Return the pose from which (M, 3) world points look most as they were measured.

    A point counts in one round if it agreed after the one before; in the first all do.
    """
    inlier_mask = np.ones(len(points_m), dtype=bool)
    for _ in range(_ROUNDS):
        points, seen = points_m[inlier_mask], measured.select(inlier_mask)
        for _ in range(_STEPS):
            hessian, gradient = _normal_equations(T_world_cam, points, seen, camera)
            step = np.asarray(-np.linalg.solve(hessian, gradient), dtype=np.float64)
            T_world_cam = T_world_cam @ se3.exp(step)
            if np.abs(step).max() < _SMALL_STEP:
                break
        points_cam_m = se3.transform(se3.inverse(T_world_cam), points_m)
        inlier_mask = measured.agree(points_cam_m, camera)
    return RefinedPose(T_world_cam, hessian, inlier_mask)


def _normal_equations(
    T_world_cam: FloatArray, points_m: FloatArray, measured: Measurements, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    points_cam_m = se3.transform(se3.inverse(T_world_cam), points_m)
    residuals, by_point = measured.residuals(points_cam_m, camera)
    # p_cam = exp(-xi) T_cam_world p_world, so d p_cam = p_cam x omega - v
    J = np.concatenate([by_point @ se3.skews(points_cam_m), -by_point], axis=2).reshape(-1, 6)
    weighted_J = robust_weights(residuals).reshape(-1, 1) * J
    # A trace of curvature keeps the step finite where few points leave a direction open.
    hessian = weighted_J.T @ J + 1e-6 * np.eye(6)
    return hessian, weighted_J.T @ residuals.ravel()

# SPDX-License-Identifier: Apache-2.0
"""Robust least squares for a camera's pose, and for the motion between two views with depth.

Of two views each match is measured twice: the reference's point as the query should see it, and
the query's point as the reference should see it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from slam.geometry import se3
from slam.geometry.reprojection import Observations, robust_weights
from slam.types import Camera, Features, FloatArray

# At most so many steps, and none after one whose norm, of this order, is less than that.
_POSE_STEPS = (4, 1e-4, np.inf)
_MOTION_STEPS = (8, 1e-6, 2)

_NormalEquations = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def _gauss_newton(
    T_a_b: FloatArray, equations: _NormalEquations, steps: int, small: float, order: float
) -> tuple[FloatArray, FloatArray]:
    """Return T_a_b after Gauss-Newton steps on its right, and the (6, 6) Hessian of the last."""
    for _ in range(steps):
        hessian, gradient = equations(T_a_b)
        step = np.asarray(-np.linalg.solve(hessian, gradient), dtype=np.float64)
        T_a_b = T_a_b @ se3.exp(step)
        if np.linalg.norm(step, order) < small:
            break
    return T_a_b, hessian


@dataclass(frozen=True)
class RefinedPose:
    """A camera's pose and the points that agree with it.

    Attributes:
        T_world_cam: (4, 4).
        hessian: (6, 6) of the robust cost, for a tangent on the right of T_world_cam.
        inlier_mask: (M,) bool.
    """

    T_world_cam: FloatArray
    hessian: FloatArray
    inlier_mask: NDArray[np.bool_]


def refine_pose(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    measured: Observations,
    camera: Camera,
    rounds: int = 2,
) -> RefinedPose:
    """Return the pose from which (M, 3) world points look most as they were measured.

    A point counts in one of the rounds if it agreed after the one before; in the first all do.
    """
    inlier_mask = np.ones(len(points_m), dtype=bool)
    for _ in range(rounds):
        seen = measured.select(inlier_mask)
        equations = partial(_pose_equations, points_m[inlier_mask], seen, camera)
        T_world_cam, hessian = _gauss_newton(T_world_cam, equations, *_POSE_STEPS)
        points_cam_m = se3.transform(se3.inverse(T_world_cam), points_m)
        inlier_mask = measured.agree(points_cam_m, camera)
    return RefinedPose(T_world_cam, hessian, inlier_mask)


def _pose_equations(
    points_m: FloatArray, measured: Observations, camera: Camera, T_world_cam: FloatArray
) -> tuple[FloatArray, FloatArray]:
    points_cam_m = se3.transform(se3.inverse(T_world_cam), points_m)
    residuals, J = measured.residuals_by_pose(points_cam_m, camera)
    weighted_J = robust_weights(residuals.T).T.reshape(-1) * J.reshape(6, -1)
    # A trace of curvature keeps the step finite where few points leave a direction open.
    hessian = weighted_J @ J.reshape(6, -1).T + 1e-6 * np.eye(6)
    return hessian, weighted_J @ residuals.ravel()


@dataclass(frozen=True)
class _View:
    """One direction: points of the other camera, and where this one saw them."""

    points_other_m: FloatArray  # (M, 3), NaN where the other camera has no depth
    measured: Observations

    def select(self, mask: NDArray[np.bool_]) -> "_View":
        return _View(self.points_other_m[mask], self.measured.select(mask))


@dataclass(frozen=True)
class Correspondences:
    """M matched features of two views."""

    query_view: _View
    reference_view: _View

    @staticmethod
    def of(
        reference: Features, query: Features, pairs: NDArray[np.int64], camera: Camera
    ) -> "Correspondences":
        """Collect the measurements of (M, 2) index pairs (reference, query)."""
        i, j = pairs.T
        return Correspondences(
            query_view=_View(reference.points_m[i], Observations.of(query, j, camera)),
            reference_view=_View(query.points_m[j], Observations.of(reference, i, camera)),
        )

    def select(self, mask: NDArray[np.bool_]) -> "Correspondences":
        """Keep the matches where the (M,) mask is true."""
        return Correspondences(self.query_view.select(mask), self.reference_view.select(mask))


def refine(
    T_ref_query: FloatArray, correspondences: Correspondences, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Return the refined T_ref_query and the (6, 6) Hessian of the robust cost there.

    The Hessian belongs to a tangent [rotation; translation] applied on the right of T_ref_query.
    """
    equations = partial(_motion_equations, correspondences, camera)
    T_ref_query, _ = _gauss_newton(T_ref_query, equations, *_MOTION_STEPS)
    return T_ref_query, equations(T_ref_query)[0]


def residual_lengths(
    T_ref_query: FloatArray, correspondences: Correspondences, camera: Camera
) -> FloatArray:
    """Return (M,) lengths of the pixel residuals in the query's image, in standard deviations."""
    view = correspondences.query_view
    points_m = se3.transform(se3.inverse(T_ref_query), view.points_other_m)
    residuals, _ = view.measured.residuals(points_m, camera)
    return np.where(points_m[:, 2] > 0.0, np.linalg.norm(residuals[:, :2], axis=1), np.inf)


def _motion_equations(
    correspondences: Correspondences, camera: Camera, T_ref_query: FloatArray
) -> tuple[FloatArray, FloatArray]:
    R_ref_query = T_ref_query[:3, :3]
    query, reference = correspondences.query_view, correspondences.reference_view

    # p_query = exp(-xi) T_query_ref p_ref, so d p_query = p_query x omega - v
    points_m = se3.transform(se3.inverse(T_ref_query), query.points_other_m)
    residuals, by_point = query.measured.residuals(points_m, camera)
    J = _chain(by_point, se3.skew(points_m), -np.eye(3))
    hessian, gradient = _weighted(residuals, J)

    # p_ref = T_ref_query exp(xi) p_query, so d p_ref = R (omega x p_query + v)
    points_m = se3.transform(T_ref_query, reference.points_other_m)
    residuals, by_point = reference.measured.residuals(points_m, camera)
    J = _chain(by_point, -R_ref_query @ se3.skew(reference.points_other_m), R_ref_query)
    more_hessian, more_gradient = _weighted(residuals, J)
    # A trace of curvature keeps the step finite where few matches leave a direction open.
    return hessian + more_hessian + 1e-6 * np.eye(6), gradient + more_gradient


def _chain(by_point: FloatArray, by_omega: FloatArray, by_v: FloatArray) -> FloatArray:
    known = np.where(np.isfinite(by_omega), by_omega, 0.0)
    return np.concatenate([by_point @ known, by_point @ by_v], axis=2)


def _weighted(residuals: FloatArray, J: FloatArray) -> tuple[FloatArray, FloatArray]:
    flat_J = J.reshape(-1, 6)
    weighted_J = robust_weights(residuals).reshape(-1, 1) * flat_J
    return weighted_J.T @ flat_J, weighted_J.T @ residuals.ravel()

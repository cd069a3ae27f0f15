# SPDX-License-Identifier: Apache-2.0
"""Robust least squares for a camera's pose, and for the motion between two views with depth.

Of two views each match is measured twice: the reference's point as the query should see it, and
the query's point as the reference should see it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled
from slam.geometry import se3
from slam.geometry.normal_equations import (
    add_as_query,
    add_as_reference,
    agreement,
    empty_equations,
    stepped,
)
from slam.geometry.reprojection import Intrinsics, Observations, intrinsics
from slam.types import Camera, Features, FloatArray

# At most so many steps, and none after one that is smaller than that.
_POSE_STEPS, _SMALL_POSE_STEP = 4, 1e-4
_MOTION_STEPS, _SMALL_MOTION_STEP = 8, 1e-6


@dataclass(frozen=True)
class RefinedPose:
    """A camera's pose and the points that agree with it.

    Attributes:
        T_world_cam: (4, 4).
        hessian: (6, 6), Gauss and Newton's, of the robust cost of whitened residuals, before the
            last step: the information of the tangent [rotation; translation] in the camera's frame,
            `T_world_cam @ exp(xi)`; rad^-2, rad^-1 m^-1, m^-2.
        inlier_mask: (M,) bool, those that agree with it.
    """

    T_world_cam: FloatArray
    hessian: FloatArray
    inlier_mask: NDArray[np.bool_]


def refine_pose(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    measured: Observations,
    camera: Camera,
    inlier_mask: NDArray[np.bool_] | None = None,
    rounds: int = 2,
) -> RefinedPose:
    """Return the pose from which (M, 3) world points look most as they were measured.

    A point counts in one of the rounds if it agreed after the one before; in the first the (M,)
    mask tells, or all do.
    """
    first = np.ones(len(points_m), bool) if inlier_mask is None else inlier_mask.copy()
    points_m = np.ascontiguousarray(points_m)
    found = _refined_pose(
        T_world_cam, points_m, measured.seen, measured.sigma, intrinsics(camera), first, rounds
    )
    return RefinedPose(*found)


@compiled
def _refined_pose(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    inlier_mask: NDArray[np.bool_],
    rounds: int,
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    hessian, gradient = empty_equations()
    for _ in range(rounds):
        for _ in range(_POSE_STEPS):
            hessian, gradient = empty_equations()
            add_as_query(T_world_cam, points_m, seen, sigma, inlier_mask, camera, hessian, gradient)
            T_world_cam, step = stepped(T_world_cam, hessian, gradient)
            largest = 0.0
            for i in range(6):
                largest = max(largest, abs(step[i]))
            if largest < _SMALL_POSE_STEP:
                break
        agreement(T_world_cam, points_m, seen, sigma, camera, inlier_mask)
    return T_world_cam, hessian, inlier_mask


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
        reference: Features,
        query: Features,
        pairs: NDArray[np.int64],
        camera: Camera,
        reference_camera: Camera | None = None,
    ) -> "Correspondences":
        """Collect the measurements of (M, 2) index pairs (reference, query).

        The reference may be of another camera than the query; all is as if that had seen it.
        """
        i, j = pairs.T
        other = reference_camera or camera
        seen_by_ref = Observations.of(reference, i, other).seen_by(other, camera)
        return Correspondences(
            query_view=_View(_points_m(reference, i), Observations.of(query, j, camera)),
            reference_view=_View(_points_m(query, j), seen_by_ref),
        )

    def select(self, mask: NDArray[np.bool_]) -> "Correspondences":
        """Keep the matches where the (M,) mask is true."""
        return Correspondences(self.query_view.select(mask), self.reference_view.select(mask))


def _points_m(features: Features, index: NDArray[np.int64]) -> FloatArray:
    return features.points_m[index].astype(np.float64)


def refine(
    T_ref_query: FloatArray, correspondences: Correspondences, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Return the refined T_ref_query and the (6, 6) Hessian of the robust cost there.

    The Hessian belongs to a tangent [rotation; translation] applied on the right of T_ref_query.
    """
    query, reference = correspondences.query_view, correspondences.reference_view
    return _refined_motion(
        T_ref_query,
        query.points_other_m,
        query.measured.seen,
        query.measured.sigma,
        reference.points_other_m,
        reference.measured.seen,
        reference.measured.sigma,
        intrinsics(camera),
    )


@compiled
def _refined_motion(
    T_ref_query: FloatArray,
    points_ref_m: FloatArray,
    seen_by_query: FloatArray,
    query_sigma: FloatArray,
    points_query_m: FloatArray,
    seen_by_ref: FloatArray,
    ref_sigma: FloatArray,
    camera: Intrinsics,
) -> tuple[FloatArray, FloatArray]:
    every = np.ones(len(points_ref_m), np.bool_)
    is_done = False
    for n in range(_MOTION_STEPS + 1):
        hessian, gradient = empty_equations()
        add_as_query(
            T_ref_query, points_ref_m, seen_by_query, query_sigma, every, camera, hessian, gradient
        )
        add_as_reference(
            T_ref_query, points_query_m, seen_by_ref, ref_sigma, camera, hessian, gradient
        )
        if is_done or n == _MOTION_STEPS:
            break
        T_ref_query, step = stepped(T_ref_query, hessian, gradient)
        squared = 0.0
        for i in range(6):
            squared += step[i] * step[i]
        is_done = squared < _SMALL_MOTION_STEP**2
    return T_ref_query, hessian


def residual_lengths(
    T_ref_query: FloatArray, correspondences: Correspondences, camera: Camera
) -> FloatArray:
    """Return (M,) lengths of the pixel residuals in the query's image, in standard deviations."""
    view = correspondences.query_view
    points_m = se3.transform(se3.inverse(T_ref_query), view.points_other_m)
    residuals, _ = view.measured.residuals(points_m, camera)
    return np.where(points_m[:, 2] > 0.0, np.linalg.norm(residuals[:, :2], axis=1), np.inf)

# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment: poses and points that together explain what all cameras measured.

Levenberg-Marquardt on the camera poses alone: the points are eliminated (Schur complement), all
of them at once, as each is 3x3. What else is known of the motion from one camera to another, by an
odometry from elsewhere say, is one more measurement of the two.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from slam.geometry import reprojection, se3
from slam.geometry.reprojection import Observations, intrinsics
from slam.mapping.bundle_equations import (
    agreement,
    inverses,
    linearised,
    point_steps,
    reduce,
    robust_cost,
    solution,
)
from slam.types import Camera, FloatArray, IntArray

_FIRST_DAMPING = 1e-5
_SMALL_GAIN = 1e-4  # relative; less is not worth another step
_MAX_REFUSALS = 5
_TRACE = 1e-9
_MOST_DENSE = 600  # unknowns; of more most pairs are not tied to each other


@dataclass(frozen=True)
class Motions:
    """Motions between cameras that something other than the points has measured.

    Attributes:
        ref_of, query_of: (M,) int, the two cameras of each.
        T_ref_query: (M, 4, 4).
        information: (M, 6, 6), of a tangent [rotation; translation] on the right.
    """

    ref_of: IntArray
    query_of: IntArray
    T_ref_query: FloatArray
    information: FloatArray


NO_MOTIONS = Motions(
    np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6))
)


@dataclass(frozen=True)
class Bundle:
    """Cameras, points, and the observations of one by the other.

    Attributes:
        T_world_cam: (K, 4, 4).
        is_fixed: (K,) bool, cameras that stay; at least one.
        points_m: (P, 3), world frame.
        camera_of, point_of: (O,) int, the camera and the point of each observation; the points
            in increasing order.
        measured: the O observations.
        motions: what else is known of the cameras.
    """

    T_world_cam: FloatArray
    is_fixed: NDArray[np.bool_]
    points_m: FloatArray
    camera_of: IntArray
    point_of: IntArray
    measured: Observations
    motions: Motions = NO_MOTIONS

    def select(self, mask: NDArray[np.bool_]) -> "Bundle":
        """Keep some of the observations, by an (O,) mask."""
        return replace(
            self,
            camera_of=self.camera_of[mask],
            point_of=self.point_of[mask],
            measured=self.measured.select(mask),
        )


def adjust(bundle: Bundle, camera: Camera, max_steps: int) -> Bundle:
    """Return the bundle with the poses and points that fit the observations best."""
    if len(bundle.measured) == 0 or bundle.is_fixed.all():
        return bundle
    damping, refusals = _FIRST_DAMPING, 0
    cost = _cost(bundle, camera)
    system: _System | None = None
    for _ in range(max_steps):
        system = system or _linearise(bundle, camera)
        moved = _moved(bundle, *_solve(system, bundle, damping))
        after = _cost(moved, camera)
        # What nothing holds any more may have no solution, and what is NaN has no cost.
        if not (after <= cost and _is_finite(moved)):
            damping, refusals = 10.0 * damping, refusals + 1
            if refusals > _MAX_REFUSALS:
                break
            continue
        gain = (cost - after) / max(cost, 1e-300)
        bundle, cost, system = moved, after, None
        damping, refusals = 0.1 * damping, 0
        if gain < _SMALL_GAIN:
            break
    return bundle


def _is_finite(bundle: Bundle) -> bool:
    return bool(np.isfinite(bundle.T_world_cam).all() and np.isfinite(bundle.points_m).all())


def agreeing(bundle: Bundle, camera: Camera) -> NDArray[np.bool_]:
    """Return (O,) bool: the observations that fit."""
    return agreement(*_observed(bundle), intrinsics(camera), reprojection.LIMIT)


@dataclass(frozen=True)
class _System:
    """The Gauss-Newton approximation of the robust cost, and of what the motions say."""

    H_cam: FloatArray  # (K, 6, 6)
    g_cam: FloatArray  # (K, 6)
    H_point: FloatArray  # (P, 3, 3)
    g_point: FloatArray  # (P, 3)
    W: FloatArray  # (O, 3, 6), point by camera, per observation
    H_motion: FloatArray  # (M, 6, 6), reference by query camera, per motion


def _observed(
    bundle: Bundle,
) -> tuple[FloatArray, FloatArray, IntArray, IntArray, FloatArray, FloatArray]:
    measured = bundle.measured
    return (
        bundle.T_world_cam,
        bundle.points_m,
        bundle.camera_of,
        bundle.point_of,
        measured.seen,
        measured.sigma,
    )


def _widths() -> tuple[float, float]:
    return reprojection.HUBER, reprojection.CAUCHY


def _cost(bundle: Bundle, camera: Camera) -> float:
    errors = _motion_errors(bundle)
    chi_square = np.einsum("mi,mij,mj->", errors, bundle.motions.information, errors)
    costs = robust_cost(*_observed(bundle), intrinsics(camera), _widths())
    return costs + 0.5 * float(chi_square)


def _motion_errors(bundle: Bundle) -> FloatArray:
    motions, T_world_cam = bundle.motions, bundle.T_world_cam
    if not len(motions.ref_of):
        return np.zeros((0, 6))
    T_ref_query = se3.inverse(T_world_cam[motions.ref_of]) @ T_world_cam[motions.query_of]
    return se3.log(se3.inverse(motions.T_ref_query) @ T_ref_query)


def _linearise(bundle: Bundle, camera: Camera) -> _System:
    equations = linearised(*_observed(bundle), intrinsics(camera), _widths())
    return _System(*equations, _add_motions(bundle, *equations[:2]))


def _add_motions(bundle: Bundle, H_cam: FloatArray, g_cam: FloatArray) -> FloatArray:
    """Add the errors of motions to the cameras' equations; return what ties two cameras."""
    motions, T_world_cam = bundle.motions, bundle.T_world_cam
    if not len(motions.ref_of):
        return np.zeros((0, 6, 6))
    errors = _motion_errors(bundle)
    # log(exp(e) exp(xi)) is e + xi to first order, and more exactly with half their bracket.
    by_query = np.eye(6) + 0.5 * se3.small_adjoint(errors)
    T_query_ref = se3.inverse(T_world_cam[motions.query_of]) @ T_world_cam[motions.ref_of]
    by_ref = -by_query @ se3.adjoint(T_query_ref)
    for camera_of, J in ((motions.ref_of, by_ref), (motions.query_of, by_query)):
        weighted = J.transpose(0, 2, 1) @ motions.information
        np.add.at(H_cam, camera_of, weighted @ J)
        np.add.at(g_cam, camera_of, np.einsum("mij,mj->mi", weighted, errors))
    return np.asarray(by_ref.transpose(0, 2, 1) @ motions.information @ by_query)


def _solve(system: _System, bundle: Bundle, damping: float) -> tuple[FloatArray, FloatArray]:
    """Return the damped step of cameras (K, 6) and of points (P, 3)."""
    free = np.flatnonzero(~bundle.is_fixed)
    free_of = np.where(bundle.is_fixed, -1, np.cumsum(~bundle.is_fixed) - 1)
    S, g = _camera_equations(system, bundle.motions, free, free_of, damping)
    H_point_inverse = inverses(_damped(system.H_point, damping))
    starts = np.searchsorted(bundle.point_of, np.arange(len(system.H_point) + 1))
    # Two cameras that see the same point are tied through it.
    reduce(H_point_inverse, system.g_point, system.W, starts, free_of[bundle.camera_of], S, g)
    step_cam = np.zeros(system.g_cam.shape)
    step_cam[free] = -_solution(S, g).reshape(-1, 6)
    step_point = point_steps(
        H_point_inverse, system.g_point, system.W, bundle.camera_of, bundle.point_of, step_cam
    )
    return step_cam, step_point


def _camera_equations(
    system: _System, motions: Motions, free: IntArray, free_of: IntArray, damping: float
) -> tuple[FloatArray, FloatArray]:
    """Return the (6 F, 6 F) Hessian of free cameras, what is above its diagonal, and gradient."""
    count = len(free)
    blocks, each = np.zeros((count, 6, count, 6)), np.arange(count)
    blocks[each, :, each, :] = _damped(system.H_cam[free], damping)
    ends = (free_of[motions.ref_of], free_of[motions.query_of])
    for a, b, tie in zip(*ends, system.H_motion, strict=True):
        if min(a, b) >= 0:
            blocks[min(a, b), :, max(a, b), :] += tie if a < b else tie.T
    return blocks.reshape(6 * count, 6 * count), system.g_cam[free].ravel()


def _solution(S: FloatArray, g: FloatArray) -> FloatArray:
    if len(S) <= _MOST_DENSE:
        return solution(S, g)
    upper = scipy.sparse.csc_array(scipy.sparse.triu(S))
    whole = upper + scipy.sparse.csc_array(scipy.sparse.triu(S, 1)).T
    return np.asarray(splu(whole.tocsc()).solve(g))


def _damped(blocks: FloatArray, damping: float) -> FloatArray:
    size = blocks.shape[-1]
    diagonal = np.einsum("nii->ni", blocks)
    # A trace of curvature keeps what no observation holds where it is: of each three that have one
    # unit, so that the size of the world does not count, or next to nothing where all are 0.
    threes = diagonal.reshape(len(blocks), -1, 3)
    trace = np.repeat(_TRACE * threes.mean(axis=2) + 1e-12, 3, axis=1)
    return np.asarray(blocks + (damping * diagonal + trace)[:, :, None] * np.eye(size))


def _moved(bundle: Bundle, step_cam: FloatArray, step_point: FloatArray) -> Bundle:
    T_world_cam, free = bundle.T_world_cam.copy(), ~bundle.is_fixed
    T_world_cam[free] = T_world_cam[free] @ se3.exp(step_cam[free])
    return replace(bundle, T_world_cam=T_world_cam, points_m=bundle.points_m + step_point)

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

from slam.geometry import se3
from slam.geometry.reprojection import Observations, robust_costs, robust_weights
from slam.types import Camera, FloatArray, IntArray

_FIRST_DAMPING = 1e-5
_SMALL_GAIN = 1e-4  # relative; less is not worth another step
_MAX_REFUSALS = 5
_TRACE = 1e-9


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
    structure = _Structure(bundle)
    damping, refusals = _FIRST_DAMPING, 0
    misfit = _misfit(bundle, camera)
    system: _System | None = None
    for _ in range(max_steps):
        system = system or _linearise(bundle, misfit, structure)
        moved = _moved(bundle, *_solve(system, structure, damping))
        after = _misfit(moved, camera)
        if after.cost > misfit.cost:
            damping, refusals = 10.0 * damping, refusals + 1
            if refusals > _MAX_REFUSALS:
                break
            continue
        gain = (misfit.cost - after.cost) / max(misfit.cost, 1e-300)
        bundle, misfit, system = moved, after, None
        damping, refusals = 0.1 * damping, 0
        if gain < _SMALL_GAIN:
            break
    return bundle


def agreeing(bundle: Bundle, camera: Camera) -> NDArray[np.bool_]:
    """Return (O,) bool: the observations that fit."""
    return bundle.measured.agree(_points_in_cameras(bundle), camera)


class _Structure:
    """Which camera sees which point, as sparse matrices; the same in every step.

    Attributes:
        free: (F,), the cameras that may move.
        by_camera, by_point: (K, O) and (P, O), they add up what belongs to the same one.
    """

    def __init__(self, bundle: Bundle) -> None:
        points = len(bundle.points_m)
        self.by_camera = _sums(bundle.camera_of, len(bundle.is_fixed))
        self.by_point = _sums(bundle.point_of, points)
        self.free = np.flatnonzero(~bundle.is_fixed)
        self._of_free = np.flatnonzero(~bundle.is_fixed[bundle.camera_of])
        self._column = np.searchsorted(self.free, bundle.camera_of[self._of_free])
        self._point_of = bundle.point_of[self._of_free]
        self._row_starts = np.searchsorted(self._point_of, np.arange(points + 1))
        ends = (bundle.motions.ref_of, bundle.motions.query_of)
        self._both_free = np.flatnonzero(~bundle.is_fixed[ends[0]] & ~bundle.is_fixed[ends[1]])
        self._ends = [np.searchsorted(self.free, end[self._both_free]) for end in ends]

    def blocks(self, W: FloatArray, by_point: FloatArray | None = None) -> scipy.sparse.bsr_array:
        """Return (O, 3, 6) blocks, those of free cameras, as a (3 P, 6 F) matrix.

        Each is multiplied by the (P, 3, 3) matrix of its point from the left, if there are such.
        """
        blocks = W[self._of_free]
        if by_point is not None:
            blocks = by_point[self._point_of] @ blocks
        shape = (3 * (len(self._row_starts) - 1), 6 * len(self.free))
        return scipy.sparse.bsr_array((blocks, self._column, self._row_starts), shape=shape)

    def ties(self, H_motion: FloatArray) -> scipy.sparse.csr_array:
        """Return (M, 6, 6) blocks and their transposes, those of free cameras, as (6 F, 6 F)."""
        blocks, (ref, query) = H_motion[self._both_free], self._ends
        blocks = np.concatenate([blocks, blocks.transpose(0, 2, 1)])
        rows, columns = np.concatenate([ref, query]), np.concatenate([query, ref])
        inner = np.arange(6)
        i = np.broadcast_to(6 * rows[:, None, None] + inner[:, None], blocks.shape)
        j = np.broadcast_to(6 * columns[:, None, None] + inner, blocks.shape)
        entries = (blocks.ravel(), (i.ravel(), j.ravel()))
        return scipy.sparse.csr_array(entries, shape=(6 * len(self.free), 6 * len(self.free)))


@dataclass(frozen=True)
class _Misfit:
    """How far the observations are off, and the robust cost of it."""

    residuals: FloatArray  # (3, O), whitened, weighted
    by_point: FloatArray  # (3, 3, O), their derivative by the point in the camera's frame
    points_cam_m: FloatArray  # (3, O)
    motions: FloatArray  # (M, 6), how far those of the cameras are off, as a tangent
    cost: float  # of all together


@dataclass(frozen=True)
class _System:
    """The Gauss-Newton approximation of the robust cost."""

    H_cam: FloatArray  # (K, 6, 6)
    g_cam: FloatArray  # (K, 6)
    H_point: FloatArray  # (P, 3, 3)
    g_point: FloatArray  # (P, 3)
    W: FloatArray  # (O, 3, 6), point by camera, per observation
    H_motion: FloatArray  # (M, 6, 6), reference by query camera, per motion


def _points_in_cameras(bundle: Bundle) -> FloatArray:
    T_cam_world = se3.inverse(bundle.T_world_cam)[bundle.camera_of]
    points = bundle.points_m[bundle.point_of]
    rotated: FloatArray = np.einsum("oij,oj->oi", T_cam_world[:, :3, :3], points)
    return rotated + T_cam_world[:, :3, 3]


def _misfit(bundle: Bundle, camera: Camera) -> _Misfit:
    points_cam_m = _points_in_cameras(bundle)
    residuals, by_point = bundle.measured.residuals(points_cam_m, camera)
    roots = np.sqrt(robust_weights(residuals))
    motions, errors = bundle.motions, _motion_errors(bundle)
    chi_square = np.einsum("mi,mij,mj->", errors, motions.information, errors)
    return _Misfit(
        residuals=_observations_last(roots * residuals),
        by_point=_observations_last(roots[:, :, None] * by_point),
        points_cam_m=_observations_last(points_cam_m),
        motions=errors,
        cost=float(robust_costs(residuals).sum() + 0.5 * chi_square),
    )


def _motion_errors(bundle: Bundle) -> FloatArray:
    motions, T_world_cam = bundle.motions, bundle.T_world_cam
    T_ref_query = se3.inverse(T_world_cam[motions.ref_of]) @ T_world_cam[motions.query_of]
    return se3.log(se3.inverse(motions.T_ref_query) @ T_ref_query)


def _observations_last(values: FloatArray) -> FloatArray:
    """Return (..., O) of (O, ...): numpy multiplies small matrices several times faster so."""
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))


def _linearise(bundle: Bundle, misfit: _Misfit, structure: _Structure) -> _System:
    r, A = misfit.residuals, misfit.by_point
    # p_cam = exp(-xi) T_cam_world p_world: d p_cam = p_cam x omega - v + R_cam_world d p_world
    R_world_cam = _observations_last(bundle.T_world_cam[bundle.camera_of, :3, :3])
    J_cam = np.concatenate([np.cross(A, misfit.points_cam_m[None], axis=1), -A], axis=1)
    J_point = np.einsum("rio,jio->rjo", A, R_world_cam)
    H_cam = _added(structure.by_camera, np.einsum("rio,rjo->oij", J_cam, J_cam))
    g_cam = _added(structure.by_camera, np.einsum("rio,ro->oi", J_cam, r))
    return _System(
        H_motion=_add_motions(bundle, misfit.motions, H_cam, g_cam),
        H_cam=H_cam,
        g_cam=g_cam,
        H_point=_added(structure.by_point, np.einsum("rio,rjo->oij", J_point, J_point)),
        g_point=_added(structure.by_point, np.einsum("rio,ro->oi", J_point, r)),
        W=np.einsum("rio,rjo->oij", J_point, J_cam),
    )


def _add_motions(
    bundle: Bundle, errors: FloatArray, H_cam: FloatArray, g_cam: FloatArray
) -> FloatArray:
    """Add (M, 6) errors of motions to the cameras' equations; return what ties two cameras."""
    motions, T_world_cam = bundle.motions, bundle.T_world_cam
    # log(exp(e) exp(xi)) is e + xi to first order, and more exactly with half their bracket.
    by_query = np.eye(6) + 0.5 * se3.small_adjoint(errors)
    T_query_ref = se3.inverse(T_world_cam[motions.query_of]) @ T_world_cam[motions.ref_of]
    by_ref = -by_query @ se3.adjoint(T_query_ref)
    for camera_of, J in ((motions.ref_of, by_ref), (motions.query_of, by_query)):
        weighted = J.transpose(0, 2, 1) @ motions.information
        np.add.at(H_cam, camera_of, weighted @ J)
        np.add.at(g_cam, camera_of, np.einsum("mij,mj->mi", weighted, errors))
    return np.asarray(by_ref.transpose(0, 2, 1) @ motions.information @ by_query)


def _sums(owner_of: IntArray, owners: int) -> scipy.sparse.csr_array:
    """Return the matrix that adds up, per owner, the observations that are its own."""
    entries = (np.ones(len(owner_of)), (owner_of, np.arange(len(owner_of))))
    return scipy.sparse.csr_array(entries, shape=(owners, len(owner_of)))


def _added(by: scipy.sparse.csr_array, values: FloatArray) -> FloatArray:
    return np.asarray(by @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])


def _solve(system: _System, structure: _Structure, damping: float) -> tuple[FloatArray, FloatArray]:
    """Return the damped step of cameras (K, 6) and of points (P, 3)."""
    free = structure.free
    H_cam = scipy.sparse.bsr_array(
        (_damped(system.H_cam[free], damping), np.arange(len(free)), np.arange(len(free) + 1))
    )
    H_point_inverse = np.asarray(np.linalg.inv(_damped(system.H_point, damping)), np.float64)
    W = structure.blocks(system.W)
    inverse_W = structure.blocks(system.W, H_point_inverse)
    # Two cameras that see the same point are tied through it.
    reduced = (H_cam - W.T @ inverse_W).tocsc()
    if len(system.H_motion):
        reduced = (reduced + structure.ties(system.H_motion)).tocsc()
    step_free = -splu(reduced).solve(
        system.g_cam[free].ravel() - inverse_W.T @ system.g_point.ravel()
    )
    by_cameras = (inverse_W @ step_free).reshape(-1, 3)
    step_cam = np.zeros(system.g_cam.shape)
    step_cam[free] = step_free.reshape(-1, 6)
    return step_cam, -np.einsum("pij,pj->pi", H_point_inverse, system.g_point) - by_cameras


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

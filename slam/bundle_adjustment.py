# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment: poses and points that together explain what all cameras measured.

Levenberg-Marquardt on the camera poses alone: the points are eliminated (Schur complement), all
of them at once, as each is 3x3.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from slam import se3
from slam.measurement import Measurements, robust
from slam.types import Camera, FloatArray

IntArray = NDArray[np.int64]

_FIRST_DAMPING = 1e-5
_SMALL_GAIN = 1e-4  # relative; less is not worth another step
_MAX_REFUSALS = 5


@dataclass(frozen=True)
class Bundle:
    """Cameras, points, and who saw what.

    Attributes:
        T_world_cam: (K, 4, 4).
        is_fixed: (K,) bool, cameras that stay; at least one.
        points_m: (P, 3), world frame.
        camera_of, point_of: (O,) int, the camera and the point of each observation; the points
            in increasing order.
        measured: the O observations.
    """

    T_world_cam: FloatArray
    is_fixed: NDArray[np.bool_]
    points_m: FloatArray
    camera_of: IntArray
    point_of: IntArray
    measured: Measurements

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
    system = _linearise(bundle, camera)
    for _ in range(max_steps):
        moved = _moved(bundle, *_solve(bundle, system, damping))
        candidate = _linearise(moved, camera)
        if candidate.cost > system.cost:
            damping, refusals = 10.0 * damping, refusals + 1
            if refusals > _MAX_REFUSALS:
                break
            continue
        gain = (system.cost - candidate.cost) / max(system.cost, 1e-300)
        bundle, system, damping, refusals = moved, candidate, 0.1 * damping, 0
        if gain < _SMALL_GAIN:
            break
    return bundle


def agreeing(bundle: Bundle, camera: Camera) -> NDArray[np.bool_]:
    """Return (O,) bool: the observations that fit."""
    return bundle.measured.agree(_points_in_cameras(bundle), camera)


@dataclass(frozen=True)
class _System:
    """The robust cost and its Gauss-Newton approximation."""

    cost: float
    H_cam: FloatArray  # (K, 6, 6)
    g_cam: FloatArray  # (K, 6)
    H_point: FloatArray  # (P, 3, 3)
    g_point: FloatArray  # (P, 3)
    W: FloatArray  # (O, 6, 3), camera by point, per observation


def _points_in_cameras(bundle: Bundle) -> FloatArray:
    T_cam_world = se3.inverse(bundle.T_world_cam)[bundle.camera_of]
    points = bundle.points_m[bundle.point_of]
    rotated: FloatArray = np.einsum("oij,oj->oi", T_cam_world[:, :3, :3], points)
    return rotated + T_cam_world[:, :3, 3]


def _linearise(bundle: Bundle, camera: Camera) -> _System:
    points_cam_m = _points_in_cameras(bundle)
    residuals, by_point_cam = bundle.measured.residuals(points_cam_m, camera)
    costs, weights = robust(residuals)
    # p_cam = exp(-xi) T_cam_world p_world: d p_cam = p_cam x omega - v + R_cam_world d p_world
    R_cam_world = np.swapaxes(bundle.T_world_cam[:, :3, :3], 1, 2)[bundle.camera_of]
    J_cam = np.concatenate([by_point_cam @ se3.skews(points_cam_m), -by_point_cam], axis=2)
    J_point = by_point_cam @ R_cam_world
    weighted_cam = np.swapaxes(weights[:, :, None] * J_cam, 1, 2)
    weighted_point = np.swapaxes(weights[:, :, None] * J_point, 1, 2)
    column = residuals[:, :, None]
    cameras, points = len(bundle.T_world_cam), len(bundle.points_m)
    return _System(
        cost=float(costs.sum()),
        H_cam=_sum_by(bundle.camera_of, weighted_cam @ J_cam, cameras),
        g_cam=_sum_by(bundle.camera_of, weighted_cam @ column, cameras)[:, :, 0],
        H_point=_sum_by(bundle.point_of, weighted_point @ J_point, points),
        g_point=_sum_by(bundle.point_of, weighted_point @ column, points)[:, :, 0],
        W=weighted_cam @ J_point,
    )


def _solve(bundle: Bundle, system: _System, damping: float) -> tuple[FloatArray, FloatArray]:
    """Return the damped step of cameras (K, 6) and of points (P, 3)."""
    H_cam, H_point = _damped(system.H_cam, damping), _damped(system.H_point, damping)
    H_point_inverse = np.linalg.inv(H_point)
    Y = system.W @ H_point_inverse[bundle.point_of]  # (O, 6, 3)
    free = np.flatnonzero(~bundle.is_fixed)
    rank = np.full(len(bundle.is_fixed), -1)
    rank[free] = np.arange(len(free))
    # Two cameras that see the same point are tied through it.
    of_free = np.flatnonzero(~bundle.is_fixed[bundle.camera_of])
    a, b = _pairs_of_equal(bundle.point_of[of_free])
    a, b = of_free[a], of_free[b]
    ties = -Y[a] @ np.swapaxes(system.W[b], 1, 2)
    rows = np.concatenate([rank[free], rank[bundle.camera_of[a]]])
    columns = np.concatenate([rank[free], rank[bundle.camera_of[b]]])
    S = _block_matrix(rows, columns, np.concatenate([H_cam[free], ties]), len(free))
    through_points = (Y @ system.g_point[bundle.point_of][:, :, None])[:, :, 0]
    reduced = system.g_cam - _sum_by(bundle.camera_of, through_points, len(bundle.T_world_cam))
    step_cam = np.zeros((len(bundle.T_world_cam), 6))
    step_cam[free] = -splu(S).solve(reduced[free].ravel()).reshape(-1, 6)
    by_cameras = (np.swapaxes(system.W, 1, 2) @ step_cam[bundle.camera_of][:, :, None])[:, :, 0]
    pull = system.g_point + _sum_by(bundle.point_of, by_cameras, len(bundle.points_m))
    return step_cam, -(H_point_inverse @ pull[:, :, None])[:, :, 0]


def _moved(bundle: Bundle, step_cam: FloatArray, step_point: FloatArray) -> Bundle:
    T_world_cam = bundle.T_world_cam.copy()
    for k in np.flatnonzero(~bundle.is_fixed):
        T_world_cam[k] = T_world_cam[k] @ se3.exp(step_cam[k])
    return replace(bundle, T_world_cam=T_world_cam, points_m=bundle.points_m + step_point)


def _damped(blocks: FloatArray, damping: float) -> FloatArray:
    size = blocks.shape[-1]
    diagonal = np.einsum("nii->ni", blocks)
    # The trace of curvature keeps what no observation holds where it is.
    return np.asarray(blocks + (damping * diagonal + 1e-6)[:, :, None] * np.eye(size))


def _sum_by(index: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Return (count, ...), the sums of the values with the same index."""
    flat = values.reshape(len(values), -1)
    rows = scipy.sparse.csr_matrix(
        (np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index))
    )
    return np.asarray(rows @ flat).reshape(count, *values.shape[1:])


def _pairs_of_equal(values: IntArray) -> tuple[IntArray, IntArray]:
    """Return all index pairs (i, j), i = j included, of equal entries of increasing values."""
    _, first, inverse, counts = np.unique(
        values, return_index=True, return_inverse=True, return_counts=True
    )
    lengths = counts[inverse]
    i = np.repeat(np.arange(len(values)), lengths)
    within = np.arange(len(i)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return i, first[inverse][i] + within


def _block_matrix(
    rows: IntArray, columns: IntArray, blocks: FloatArray, count: int
) -> scipy.sparse.csc_matrix:
    """Return the (6 count, 6 count) matrix with the sums of (6, 6) blocks at their places."""
    places, inverse = np.unique(rows * count + columns, return_inverse=True)
    summed = _sum_by(inverse, blocks, len(places))
    inner = np.arange(6)
    i = (6 * (places // count))[:, None, None] + inner[:, None] + np.zeros(6, dtype=np.int64)
    j = (6 * (places % count))[:, None, None] + inner[None, :] + np.zeros((6, 1), dtype=np.int64)
    entries = (summed.ravel(), (i.ravel(), j.ravel()))
    return scipy.sparse.csc_matrix(entries, shape=(6 * count, 6 * count))

# SPDX-License-Identifier: Apache-2.0
"""What one view's measurements say of a pose: Gauss-Newton's equations, in compiled loops.

Points and tangents as in `refinement`. A measurement that is unknown, NaN, says nothing.
"""

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import inlined
from slam.geometry.reprojection import CAUCHY, HUBER, LIMIT, Intrinsics
from slam.types import FloatArray

# A trace of curvature keeps the step finite where few points leave a direction open.
_TRACE = 1e-6


@inlined
def empty_equations() -> tuple[FloatArray, FloatArray]:
    """Return the (6, 6) Hessian and the (6,) gradient of nothing."""
    return _TRACE * np.eye(6), np.zeros(6)


@inlined
def _add_rows(
    J: FloatArray, residuals: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> None:
    """Add a point's (3, 6) derivatives and (3,) whitened residuals, weighted as is robust."""
    length = np.sqrt(residuals[0] * residuals[0] + residuals[1] * residuals[1])
    pixel_weight = min(1.0, HUBER / max(length, 1e-12))
    depth_weight = 1.0 / (1.0 + (residuals[2] / CAUCHY) ** 2)
    for row in range(3):
        weight = pixel_weight if row < 2 else depth_weight
        for a in range(6):
            weighted = weight * J[row, a]
            gradient[a] += weighted * residuals[row]
            for b in range(a + 1):
                hessian[a, b] += weighted * J[row, b]


@inlined
def _mirror(hessian: FloatArray) -> None:
    for a in range(6):
        for b in range(a):
            hessian[b, a] = hessian[a, b]


@inlined
def add_as_query(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    seen: FloatArray,
    sigma: FloatArray,
    mask: NDArray[np.bool_],
    camera: Intrinsics,
    hessian: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add what a camera saw of the masked of (M, 3) points to the equations of its own pose.

    `seen` and `sigma` as in `Observations`; the tangent is on the right of T_world_cam.
    """
    fx, fy, cx, cy, baseline_fx = camera
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    J, residuals = np.zeros((3, 6)), np.zeros(3)
    for i in range(len(points_m)):
        if not mask[i]:
            continue
        a, b, c = points_m[i, 0] - t[0], points_m[i, 1] - t[1], points_m[i, 2] - t[2]
        z = a * R[0, 2] + b * R[1, 2] + c * R[2, 2]
        if np.isnan(z):
            continue
        near = 1.0 / z if z != 0.0 else 0.0
        x = (a * R[0, 0] + b * R[1, 0] + c * R[2, 0]) * near
        y = (a * R[0, 1] + b * R[1, 1] + c * R[2, 1]) * near
        for row in range(3):
            residuals[row] = 0.0
            for k in range(6):
                J[row, k] = 0.0
        # p_cam = exp(-xi) T_cam_world p_world, so d p_cam = p_cam x omega - v
        if np.isfinite(seen[i, 0]):
            scale = fx / sigma[i, 0]
            residuals[0] = (fx * x + cx - seen[i, 0]) / sigma[i, 0]
            J[0, 0], J[0, 1], J[0, 2] = x * y * scale, -(1.0 + x * x) * scale, y * scale
            J[0, 3], J[0, 5] = -near * scale, x * near * scale
        if np.isfinite(seen[i, 1]):
            scale = fy / sigma[i, 1]
            residuals[1] = (fy * y + cy - seen[i, 1]) / sigma[i, 1]
            J[1, 0], J[1, 1], J[1, 2] = (1.0 + y * y) * scale, -x * y * scale, -x * scale
            J[1, 4], J[1, 5] = -near * scale, y * near * scale
        if np.isfinite(seen[i, 2]):
            disparity = baseline_fx * near
            scale = disparity / sigma[i, 2]
            residuals[2] = (disparity - seen[i, 2]) / sigma[i, 2]
            J[2, 0], J[2, 1], J[2, 5] = y * scale, -x * scale, near * scale
        _add_rows(J, residuals, hessian, gradient)
    _mirror(hessian)


@inlined
def _derive_by_point(
    x: float,
    y: float,
    near: float,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    residuals: FloatArray,
    by_point: FloatArray,
) -> None:
    """Set (3,) whitened residuals of a point at x, y, 1 times its depth, 1 / near, and (3, 3)."""
    fx, fy, cx, cy, baseline_fx = camera
    for row in range(3):
        residuals[row] = 0.0
        for k in range(3):
            by_point[row, k] = 0.0
    if np.isfinite(seen[0]):
        residuals[0] = (fx * x + cx - seen[0]) / sigma[0]
        by_point[0, 0], by_point[0, 2] = fx * near / sigma[0], -fx * x * near / sigma[0]
    if np.isfinite(seen[1]):
        residuals[1] = (fy * y + cy - seen[1]) / sigma[1]
        by_point[1, 1], by_point[1, 2] = fy * near / sigma[1], -fy * y * near / sigma[1]
    if np.isfinite(seen[2]):
        residuals[2] = (baseline_fx * near - seen[2]) / sigma[2]
        by_point[2, 2] = -baseline_fx * near * near / sigma[2]


@inlined
def add_as_reference(
    T_ref_query: FloatArray,
    points_query_m: FloatArray,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    hessian: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add what the reference saw of (M, 3) points that the query knows to the same equations."""
    R, t = T_ref_query[:3, :3], T_ref_query[:3, 3]
    J, residuals, by_point = np.zeros((3, 6)), np.zeros(3), np.zeros((3, 3))
    rotated = np.zeros(3)
    for i in range(len(points_query_m)):
        p, q, s = points_query_m[i, 0], points_query_m[i, 1], points_query_m[i, 2]
        z = R[2, 0] * p + R[2, 1] * q + R[2, 2] * s + t[2]
        if np.isnan(z) or z == 0.0:
            continue
        near = 1.0 / z
        x = (R[0, 0] * p + R[0, 1] * q + R[0, 2] * s + t[0]) * near
        y = (R[1, 0] * p + R[1, 1] * q + R[1, 2] * s + t[1]) * near
        _derive_by_point(x, y, near, seen[i], sigma[i], camera, residuals, by_point)
        # p_ref = T_ref_query exp(xi) p_query, so d p_ref = R (omega x p_query + v)
        for row in range(3):
            for k in range(3):
                rotated[k] = 0.0
                for j in range(3):
                    rotated[k] += by_point[row, j] * R[j, k]
            J[row, 0] = q * rotated[2] - s * rotated[1]
            J[row, 1] = s * rotated[0] - p * rotated[2]
            J[row, 2] = p * rotated[1] - q * rotated[0]
            J[row, 3], J[row, 4], J[row, 5] = rotated[0], rotated[1], rotated[2]
        _add_rows(J, residuals, hessian, gradient)
    _mirror(hessian)


@inlined
def agreement(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    mask: NDArray[np.bool_],
) -> None:
    """Set the (M,) mask to which of the points were seen where they are, as `agree` does."""
    fx, fy, cx, cy, _ = camera
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    for i in range(len(points_m)):
        a, b, c = points_m[i, 0] - t[0], points_m[i, 1] - t[1], points_m[i, 2] - t[2]
        z = a * R[0, 2] + b * R[1, 2] + c * R[2, 2]
        if not z > 0.0:
            mask[i] = False
            continue
        u = fx * (a * R[0, 0] + b * R[1, 0] + c * R[2, 0]) / z + cx
        v = fy * (a * R[0, 1] + b * R[1, 1] + c * R[2, 1]) / z + cy
        off_u, off_v = (u - seen[i, 0]) / sigma[i, 0], (v - seen[i, 1]) / sigma[i, 1]
        mask[i] = off_u * off_u + off_v * off_v < LIMIT * LIMIT


@inlined
def stepped(
    T_a_b: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return T_a_b after the Gauss-Newton step on its right, and the (6,) step."""
    step = _solved(hessian, gradient)
    length = 0.0
    for i in range(6):
        step[i] = -step[i]
        length += abs(step[i])
    if not np.isfinite(length):  # they have no solution
        return T_a_b.copy(), np.zeros(6)
    squared = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    angle = np.sqrt(squared)
    if angle < 1e-4:  # series, for what cancels
        sine, cosine, rest = 1.0 - squared / 6.0, 0.5 - squared / 24.0, 1.0 / 6.0 - squared / 120.0
    else:
        sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
        rest = (1.0 - sine) / squared
    W, R, t, moved = np.zeros((3, 3)), np.eye(3), np.zeros(3), np.eye(4)
    W[0, 1], W[0, 2], W[1, 2] = -step[2], step[1], -step[0]
    W[1, 0], W[2, 0], W[2, 1] = step[2], -step[1], step[0]
    for i in range(3):
        t[i] = step[3 + i]
        for j in range(3):
            squared_W = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            R[i, j] += sine * W[i, j] + cosine * squared_W
            t[i] += (cosine * W[i, j] + rest * squared_W) * step[3 + j]
    for i in range(3):
        moved[i, 3] = T_a_b[i, 3]
        for j in range(3):
            moved[i, 3] += T_a_b[i, j] * t[j]
            moved[i, j] = T_a_b[i, 0] * R[0, j] + T_a_b[i, 1] * R[1, j] + T_a_b[i, 2] * R[2, j]
    return moved, step


@inlined
def _solved(hessian: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the (6,) solution of the positive definite equations, by Cholesky."""
    L, solution = np.zeros((6, 6)), np.zeros(6)
    for i in range(6):
        for j in range(i + 1):
            rest = hessian[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(rest) if i == j else rest / L[j, j]
    for i in range(6):
        solution[i] = gradient[i]
        for k in range(i):
            solution[i] -= L[i, k] * solution[k]
        solution[i] /= L[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            solution[i] -= L[k, i] * solution[k]
        solution[i] /= L[i, i]
    return solution

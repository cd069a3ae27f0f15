# SPDX-License-Identifier: Apache-2.0
"""The equations of bundle adjustment, in compiled loops over observations and points.

K cameras of which F are free, P points, O observations sorted by their point.
"""

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled, inlined
from slam.geometry.reprojection import Intrinsics
from slam.types import FloatArray, IntArray

Widths = tuple[float, float]
"""Of Huber's cost of pixels and Cauchy's of depth."""


@inlined
def _residuals(
    o: int,
    T_world_cam: FloatArray,
    points_m: FloatArray,
    camera_of: IntArray,
    point_of: IntArray,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    point_cam_m: FloatArray,
    residuals: FloatArray,
) -> bool:
    """Set the (3,) point of an observation in its camera, and whitened residuals: 0 where unknown.

    Return whether the point lies before the camera.
    """
    fx, fy, cx, cy, baseline_fx = camera
    T = T_world_cam[camera_of[o]]
    for j in range(3):
        point_cam_m[j] = 0.0
        for i in range(3):
            point_cam_m[j] += T[i, j] * (points_m[point_of[o], i] - T[i, 3])
    near = 1.0 / point_cam_m[2]
    residuals[0] = (fx * point_cam_m[0] * near + cx - seen[o, 0]) / sigma[o, 0]
    residuals[1] = (fy * point_cam_m[1] * near + cy - seen[o, 1]) / sigma[o, 1]
    residuals[2] = (baseline_fx * near - seen[o, 2]) / sigma[o, 2]
    for row in range(3):
        if not np.isfinite(residuals[row]):
            residuals[row] = 0.0
    return bool(point_cam_m[2] > 0.0)


@compiled
def robust_cost(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    camera_of: IntArray,
    point_of: IntArray,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    widths: Widths,
) -> float:
    """Return the sum of the robust costs of all observations."""
    huber, cauchy = widths
    cost, p, r = 0.0, np.empty(3), np.empty(3)
    for o in range(len(camera_of)):
        _residuals(o, T_world_cam, points_m, camera_of, point_of, seen, sigma, camera, p, r)
        squared = r[0] ** 2 + r[1] ** 2
        weight = min(1.0, huber / max(np.sqrt(squared), 1e-12))
        cost += weight * squared * (1.0 - 0.5 * weight)
        cost += 0.5 * cauchy**2 * np.log1p((r[2] / cauchy) ** 2)
    return cost


@compiled
def agreement(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    camera_of: IntArray,
    point_of: IntArray,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    limit: float,
) -> NDArray[np.bool_]:
    """Return (O,) bool: the points that were seen where they are, as `Observations.agree` does."""
    agrees, p, r = np.zeros(len(seen), np.bool_), np.empty(3), np.empty(3)
    for o in range(len(camera_of)):
        is_before = _residuals(
            o, T_world_cam, points_m, camera_of, point_of, seen, sigma, camera, p, r
        )
        agrees[o] = is_before and np.sqrt(r[0] ** 2 + r[1] ** 2) < limit
    return agrees


@inlined
def _derive(row: int, p: FloatArray, camera: Intrinsics, scale: float, A: FloatArray) -> None:
    """Set the (3,) derivative of u, v or disparity by the point p in the camera's frame, scaled."""
    fx, fy, _, _, baseline_fx = camera
    near = 1.0 / p[2]
    A[0] = fx * near * scale if row == 0 else 0.0
    A[1] = fy * near * scale if row == 1 else 0.0
    along = fx * p[0] if row == 0 else fy * p[1] if row == 1 else baseline_fx
    A[2] = -along * near * near * scale


@inlined
def _add(a: FloatArray, b: FloatArray, to: FloatArray) -> None:
    """Add the outer product of two vectors."""
    for i in range(len(a)):
        for j in range(len(b)):
            to[i, j] += a[i] * b[j]


@compiled
def linearised(
    T_world_cam: FloatArray,
    points_m: FloatArray,
    camera_of: IntArray,
    point_of: IntArray,
    seen: FloatArray,
    sigma: FloatArray,
    camera: Intrinsics,
    widths: Widths,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the Gauss-Newton approximation of the robust cost.

    The Hessians (K, 6, 6) of cameras and (P, 3, 3) of points, their gradients (K, 6) and (P, 3),
    and (O, 3, 6), point by camera. Tangents are on the right of T_world_cam.
    """
    huber, cauchy = widths
    cameras, points = len(T_world_cam), len(points_m)
    H_cam, g_cam = np.zeros((cameras, 6, 6)), np.zeros((cameras, 6))
    H_point, g_point = np.zeros((points, 3, 3)), np.zeros((points, 3))
    W = np.empty((len(camera_of), 3, 6))
    p, r, A, J_cam, J_point = np.empty(3), np.empty(3), np.zeros(3), np.empty(6), np.empty(3)
    for o in range(len(camera_of)):
        k, n = camera_of[o], point_of[o]
        T = T_world_cam[k]
        _residuals(o, T_world_cam, points_m, camera_of, point_of, seen, sigma, camera, p, r)
        pixel_root = np.sqrt(min(1.0, huber / max(np.sqrt(r[0] ** 2 + r[1] ** 2), 1e-12)))
        depth_root = np.sqrt(1.0 / (1.0 + (r[2] / cauchy) ** 2))
        for i in range(3):
            for j in range(6):
                W[o, i, j] = 0.0
        for row in range(3):
            if not (np.isfinite(seen[o, row]) and p[2] != 0.0):
                continue
            root = depth_root if row == 2 else pixel_root
            _derive(row, p, camera, root / sigma[o, row], A)
            # p_cam = exp(-xi) T_cam_world p_world: d p_cam = p_cam x omega - v + R d p_world
            J_cam[0] = A[1] * p[2] - A[2] * p[1]
            J_cam[1] = A[2] * p[0] - A[0] * p[2]
            J_cam[2] = A[0] * p[1] - A[1] * p[0]
            for i in range(3):
                J_cam[3 + i] = -A[i]
                J_point[i] = T[i, 0] * A[0] + T[i, 1] * A[1] + T[i, 2] * A[2]
            _add(J_cam, J_cam, H_cam[k])
            _add(J_point, J_point, H_point[n])
            _add(J_point, J_cam, W[o])
            for i in range(6):
                g_cam[k, i] += J_cam[i] * root * r[row]
            for i in range(3):
                g_point[n, i] += J_point[i] * root * r[row]
    return H_cam, g_cam, H_point, g_point, W


@compiled
def reduce(
    H_point_inverse: FloatArray,
    g_point: FloatArray,
    W: FloatArray,
    point_starts: IntArray,
    free_of: IntArray,
    S: FloatArray,
    g: FloatArray,
) -> None:
    """Take away from the cameras' equations what their points account for (Schur complement).

    `free_of` is (O,) the number of each observation's camera among the F free ones, -1 of a fixed
    one; the observations of point n are those from `point_starts[n]` on. Changes (6 F, 6 F) S, but
    not the blocks below its diagonal, and (6 F,) g.
    """
    Y = np.empty((6, 3))
    for n in range(len(point_starts) - 1):
        for a in range(point_starts[n], point_starts[n + 1]):
            row = 6 * free_of[a]
            if row < 0:
                continue
            for i in range(6):
                for j in range(3):
                    Y[i, j] = (
                        W[a, 0, i] * H_point_inverse[n, 0, j]
                        + W[a, 1, i] * H_point_inverse[n, 1, j]
                        + W[a, 2, i] * H_point_inverse[n, 2, j]
                    )
                g[row + i] -= (
                    Y[i, 0] * g_point[n, 0] + Y[i, 1] * g_point[n, 1] + Y[i, 2] * g_point[n, 2]
                )
            for b in range(point_starts[n], point_starts[n + 1]):
                column = 6 * free_of[b]
                if column < row:
                    continue
                for i in range(6):
                    for j in range(6):
                        S[row + i, column + j] -= (
                            Y[i, 0] * W[b, 0, j] + Y[i, 1] * W[b, 1, j] + Y[i, 2] * W[b, 2, j]
                        )


@compiled
def solution(S: FloatArray, g: FloatArray) -> FloatArray:
    """Return the (N,) x of S x = g, by Cholesky; changes S, of which the upper triangle counts.

    LAPACK would do it with threads of its own, which for matrices of this size wait for each other.
    """
    x = g.copy()
    for k in range(len(S)):
        root = np.sqrt(S[k, k])
        for j in range(k, len(S)):
            S[k, j] /= root
        x[k] /= root
        for i in range(k + 1, len(S)):
            factor = S[k, i]
            x[i] -= factor * x[k]
            if factor != 0.0:
                for j in range(i, len(S)):
                    S[i, j] -= factor * S[k, j]
    for k in range(len(S) - 1, -1, -1):
        for i in range(k + 1, len(S)):
            x[k] -= S[k, i] * x[i]
        x[k] /= S[k, k]
    return x


@compiled
def inverses(H: FloatArray) -> FloatArray:
    """Return the inverses of (P, 3, 3) symmetric matrices."""
    inverse = np.empty(H.shape)
    for n in range(len(H)):
        a, b, c = H[n, 0, 0], H[n, 0, 1], H[n, 0, 2]
        d, e, f = H[n, 1, 1], H[n, 1, 2], H[n, 2, 2]
        A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
        scale = 1.0 / (a * A + b * B + c * C)
        inverse[n, 0, 0], inverse[n, 0, 1], inverse[n, 0, 2] = A * scale, B * scale, C * scale
        inverse[n, 1, 1], inverse[n, 1, 2] = (a * f - c * c) * scale, (b * c - a * e) * scale
        inverse[n, 2, 2] = (a * d - b * b) * scale
        inverse[n, 1, 0], inverse[n, 2, 0] = inverse[n, 0, 1], inverse[n, 0, 2]
        inverse[n, 2, 1] = inverse[n, 1, 2]
    return inverse


@compiled
def point_steps(
    H_point_inverse: FloatArray,
    g_point: FloatArray,
    W: FloatArray,
    camera_of: IntArray,
    point_of: IntArray,
    step_cam: FloatArray,
) -> FloatArray:
    """Return the (P, 3) steps of the points once the (K, 6) steps of the cameras are known."""
    pull = g_point.copy()
    for o in range(len(camera_of)):
        for i in range(3):
            for j in range(6):
                pull[point_of[o], i] += W[o, i, j] * step_cam[camera_of[o], j]
    steps = np.zeros(pull.shape)
    for n in range(len(pull)):
        for i in range(3):
            for j in range(3):
                steps[n, i] -= H_point_inverse[n, i, j] * pull[n, j]
    return steps

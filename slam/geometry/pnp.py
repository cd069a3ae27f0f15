# SPDX-License-Identifier: Apache-2.0
"""The camera's pose that most of some points and the pixels that show them agree on: RANSAC.

Three of them give up to four poses (Grunert's solution, as in Haralick et al. 1994, "Review and
analysis of solutions of the three point perspective pose estimation problem").
"""

import cmath

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled, inlined
from slam.types import Camera, FloatArray, IntArray

_FEWEST_POINTS = 4  # three that make the pose, and one that agrees with it
_CONFIDENCE = 0.9999  # of having drawn three that are right
_FEWEST_TRIALS = 30  # three that are right may say much worse than others where the camera is
_POLISH_STEPS = 3  # Newton's, of a root of the quartic
_REAL = 1e-6  # a root whose imaginary part is smaller is a double root, torn apart by rounding


def pose_by_ransac(
    points_m: NDArray[np.floating],
    pixels: NDArray[np.floating],
    camera: Camera,
    threshold_px: float,
    most_trials: int,
) -> tuple[FloatArray, NDArray[np.bool_]] | None:
    """Return (4, 4) T_world_cam of the three pairs that most agree with, and the mask of those.

    Of (M, 3) points and the (M, 2) undistorted pixels that show them, with a (M,) mask; None where
    no three of them give a pose that a fourth agrees with. What is drawn is the same every time.
    """
    if len(points_m) < _FEWEST_POINTS:
        return None
    rays = np.asarray((pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.float64)
    limits = (float(threshold_px / camera.fx), float(threshold_px / camera.fy))
    draws = np.random.default_rng(0).random((most_trials, 3))
    places_m: FloatArray = np.ascontiguousarray(points_m, np.float64)
    T_cam_world, count = _best_pose(places_m, rays, draws, limits)
    if count < _FEWEST_POINTS:
        return None
    mask = _agreeing(T_cam_world, places_m, rays, limits)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = T_cam_world[:3, :3].T
    T_world_cam[:3, 3] = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]
    return T_world_cam, mask


@compiled
def _best_pose(
    points_m: FloatArray, rays: FloatArray, draws: FloatArray, limits: tuple[float, float]
) -> tuple[FloatArray, int]:
    """Return the (4, 4) T_cam_world that most agree with, and how many do."""
    total = len(points_m)
    best, most = np.eye(4), 0
    chosen, poses = np.empty(3, np.int64), np.empty((4, 4, 4))
    for trial in range(len(draws)):
        _choose(draws[trial], total, chosen)
        for solution in range(_poses_of_three(points_m, rays, chosen, poses)):
            count = int(_agreeing(poses[solution], points_m, rays, limits).sum())
            if count > most:
                best, most = poses[solution].copy(), count
        if trial + 1 < _FEWEST_TRIALS:
            continue
        wrong = 1.0 - (most / total) ** 3
        if wrong <= 0.0 or (trial + 1) * np.log(wrong) < np.log(1.0 - _CONFIDENCE):
            break
    return best, most


@inlined
def _choose(draw: FloatArray, total: int, chosen: IntArray) -> None:
    """Set three different numbers below a total, by three that are drawn from 0 to 1."""
    first, second = int(draw[0] * total), int(draw[1] * (total - 1))
    second += second >= first
    third = int(draw[2] * (total - 2))
    third += third >= min(first, second)
    third += third >= max(first, second)
    chosen[0], chosen[1], chosen[2] = first, second, third


@compiled
def _agreeing(
    T_cam_world: FloatArray, points_m: FloatArray, rays: FloatArray, limits: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return (M,) bool: the points that lie before the camera and are seen within the limits."""
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    agrees = np.empty(len(points_m), np.bool_)
    for i in range(len(points_m)):
        x, y, z = points_m[i, 0], points_m[i, 1], points_m[i, 2]
        depth = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        off_u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0] - rays[i, 0] * depth) / limits[0]
        off_v = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1] - rays[i, 1] * depth) / limits[1]
        agrees[i] = depth > 0.0 and off_u * off_u + off_v * off_v <= depth * depth
    return agrees


@inlined
def _poses_of_three(
    points_m: FloatArray, rays: FloatArray, chosen: IntArray, poses: FloatArray
) -> int:
    """Set (up to 4, 4, 4) T_cam_world that see three points on their rays; return how many."""
    p, j = np.empty((3, 3)), np.empty((3, 3))
    for n in range(3):
        for i in range(3):
            p[n, i] = points_m[chosen[n], i]
        u, v = rays[chosen[n], 0], rays[chosen[n], 1]
        length = np.sqrt(u * u + v * v + 1.0)
        j[n, 0], j[n, 1], j[n, 2] = u / length, v / length, 1.0 / length
    cos_a, cos_b, cos_c = _cosine(j, 1, 2), _cosine(j, 0, 2), _cosine(j, 0, 1)
    a, b = _squared_distance(p, 1, 2), _squared_distance(p, 0, 2)
    c = _squared_distance(p, 0, 1)
    if b <= 0.0 or a <= 0.0 or c <= 0.0:
        return 0
    d, s, count = (a - c) / b, (a + c) / b, 0
    # The quartic of v = distance of the third point / distance of the first.
    k4 = (d - 1.0) ** 2 - 4.0 * c / b * cos_a**2
    k3 = 4.0 * (d * (1.0 - d) * cos_b - (1.0 - s) * cos_a * cos_c + 2.0 * c / b * cos_a**2 * cos_b)
    k2 = 2.0 * (
        d * d
        - 1.0
        + 2.0 * d * d * cos_b**2
        + 2.0 * (b - c) / b * cos_a**2
        - 4.0 * s * cos_a * cos_b * cos_c
        + 2.0 * (b - a) / b * cos_c**2
    )
    k1 = 4.0 * (-d * (1.0 + d) * cos_b + 2.0 * a / b * cos_c**2 * cos_b - (1.0 - s) * cos_a * cos_c)
    k0 = (1.0 + d) ** 2 - 4.0 * a / b * cos_c**2
    if abs(k4) < 1e-12:
        return 0
    roots, found = np.empty(4), np.empty((3, 3))
    for n in range(_real_roots(k3 / k4, k2 / k4, k1 / k4, k0 / k4, roots)):
        v = roots[n]
        below = 2.0 * (cos_c - v * cos_a)
        around = 1.0 + v * v - 2.0 * v * cos_b
        if v <= 0.0 or around <= 0.0 or abs(below) < 1e-12:
            continue
        u = ((d - 1.0) * v * v - 2.0 * d * cos_b * v + 1.0 + d) / below
        if u <= 0.0:
            continue
        first = np.sqrt(b / around)
        for i in range(3):
            found[0, i], found[1, i] = first * j[0, i], u * first * j[1, i]
            found[2, i] = v * first * j[2, i]
        if _aligned(p, found, poses[count]):
            count += 1
    return count


@inlined
def _cosine(rays: FloatArray, a: int, b: int) -> float:
    cosine = 0.0
    for i in range(3):
        cosine += rays[a, i] * rays[b, i]
    return cosine


@inlined
def _squared_distance(points: FloatArray, a: int, b: int) -> float:
    squared = 0.0
    for i in range(3):
        squared += (points[a, i] - points[b, i]) ** 2
    return squared


@inlined
def _real_roots(b: float, c: float, d: float, e: float, roots: FloatArray) -> int:
    """Set the real roots of x^4 + b x^3 + c x^2 + d x + e, by Ferrari; return how many."""
    p = c - 0.375 * b * b
    q = d - 0.5 * b * c + 0.125 * b**3
    r = e - 0.25 * b * d + b * b * c / 16.0 - 3.0 * b**4 / 256.0
    # One root m of the resolvent m^3 + p m^2 + (p^2 / 4 - r) m - q^2 / 8 = 0.
    linear, constant = 0.25 * p * p - r, -0.125 * q * q
    P = linear - p * p / 3.0
    Q = 2.0 * p**3 / 27.0 - p * linear / 3.0 + constant
    inner = cmath.sqrt(0.25 * Q * Q + P**3 / 27.0 + 0j)
    cube = -0.5 * Q + inner if abs(-0.5 * Q + inner) > abs(-0.5 * Q - inner) else -0.5 * Q - inner
    if abs(cube) < 1e-300:
        m = -p / 3.0 + 0j
    else:
        w = cmath.exp(cmath.log(cube) / 3.0)
        m = w - P / (3.0 * w) - p / 3.0
        turn = complex(-0.5, 0.8660254037844386)
        for _ in range(2):  # of its three roots the one furthest from 0, which is divided by
            w *= turn
            other = w - P / (3.0 * w) - p / 3.0
            if abs(other) > abs(m):
                m = other
    root = cmath.sqrt(2.0 * m)
    if abs(root) < 1e-150:
        return 0
    count = 0
    for sign in (1.0, -1.0):
        inside = cmath.sqrt(-(2.0 * p + 2.0 * m + sign * 2.0 * q / root))
        for other_sign in (1.0, -1.0):
            x = 0.5 * (sign * root + other_sign * inside) - 0.25 * b
            if abs(x.imag) > _REAL * (1.0 + abs(x.real)):
                continue
            real = x.real
            for _ in range(_POLISH_STEPS):
                value = (((real + b) * real + c) * real + d) * real + e
                slope = ((4.0 * real + 3.0 * b) * real + 2.0 * c) * real + d
                if slope == 0.0:
                    break
                real -= value / slope
            roots[count] = real
            count += 1
    return count


@inlined
def _axes(p: FloatArray, axes: FloatArray) -> bool:
    """Set (3, 3) columns: axes of the plane of three points; return whether they span one."""
    ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = np.sqrt(ax * ax + ay * ay + az * az)
    area = np.sqrt(nx * nx + ny * ny + nz * nz)
    if not area > 1e-9 * length * length:
        return False
    axes[0, 0], axes[1, 0], axes[2, 0] = ax / length, ay / length, az / length
    axes[0, 2], axes[1, 2], axes[2, 2] = nx / area, ny / area, nz / area
    axes[0, 1] = axes[1, 2] * axes[2, 0] - axes[2, 2] * axes[1, 0]
    axes[1, 1] = axes[2, 2] * axes[0, 0] - axes[0, 2] * axes[2, 0]
    axes[2, 1] = axes[0, 2] * axes[1, 0] - axes[1, 2] * axes[0, 0]
    return True


@inlined
def _aligned(p_world: FloatArray, p_cam: FloatArray, T_cam_world: FloatArray) -> bool:
    """Set the transform that takes (3, 3) points to others; return whether there is one."""
    world, cam = np.empty((3, 3)), np.empty((3, 3))
    if not (_axes(p_world, world) and _axes(p_cam, cam)):
        return False
    T_cam_world[3, 3] = 1.0
    for i in range(3):
        T_cam_world[3, i], T_cam_world[i, 3] = 0.0, p_cam[0, i]
        for k in range(3):
            T_cam_world[i, k] = (
                cam[i, 0] * world[k, 0] + cam[i, 1] * world[k, 1] + cam[i, 2] * world[k, 2]
            )
            T_cam_world[i, 3] -= T_cam_world[i, k] * p_world[0, k]
    return True

# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as (4, 4) float64 matrices.

`T_a_b` takes coordinates in frame b to coordinates in frame a: `p_a = T_a_b @ p_b`, so
neighbouring letters cancel: `T_world_cam = T_world_odom @ T_odom_cam`. Tangent vectors are
`[rotation (rad); translation (m)]`, GTSAM's order. Quaternions are x y z w, TUM's order.
"""

import numpy as np

from slam.types import FloatArray

_SMALL_ANGLE_RAD = 1e-8
_EYE = np.eye(3)


def from_rotation_translation(rotation: FloatArray, translation_m: FloatArray) -> FloatArray:
    """Return the (4, 4) transform of a (3, 3) rotation and a (3,) translation in metres."""
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = rotation
    T_a_b[:3, 3] = translation_m
    return T_a_b


def inverse(T_a_b: FloatArray) -> FloatArray:
    """Return T_b_a of one (4, 4) transform or of a stack (N, 4, 4)."""
    T_b_a = np.zeros_like(T_a_b)
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -np.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def transform(T_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Return (N, 3) points, metres, in frame a, given them in frame b."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def skew(v: FloatArray) -> FloatArray:
    """Return the (..., 3, 3) matrices of the cross product with (..., 3) vectors."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


def exp(tangent: FloatArray) -> FloatArray:
    """Return the (..., 4, 4) transforms of (..., 6) tangents [rotation rad; translation m]."""
    omega, v = tangent[..., :3], tangent[..., 3:]
    squared = (omega * omega).sum(axis=-1)[..., None, None]
    half_turns = np.sqrt(squared) / np.pi
    W = skew(omega)
    WW = W @ W
    a = np.sinc(half_turns)  # sin x / x
    b = 0.5 * np.sinc(0.5 * half_turns) ** 2  # (1 - cos x) / x^2, without cancellation
    c = (1.0 - a) / np.maximum(squared, _SMALL_ANGLE_RAD**2)
    T_a_b = np.zeros((*tangent.shape[:-1], 4, 4))
    T_a_b[..., :3, :3] = _EYE + a * W + b * WW
    T_a_b[..., :3, 3] = ((_EYE + b * W + c * WW) @ v[..., None])[..., 0]
    T_a_b[..., 3, 3] = 1.0
    return T_a_b


def log(T_a_b: FloatArray) -> FloatArray:
    """Return the (..., 6) tangents [rotation rad; translation m] of (..., 4, 4) transforms."""
    # Through the quaternion: stays accurate near 180 degrees, where the trace formula does not.
    quaternion = to_quaternion(T_a_b[..., :3, :3])
    vector, w = quaternion[..., :3], quaternion[..., 3:]
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    is_small = length < _SMALL_ANGLE_RAD
    safe = np.where(is_small, 1.0, length)
    omega = vector * np.where(is_small, 2.0, 2.0 * np.arctan2(safe, w) / safe)
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    W = skew(omega)
    safe = np.where(angle < _SMALL_ANGLE_RAD, 1.0, angle)
    c = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe) + 1e-300)
    V_inverse = np.eye(3) - 0.5 * W + np.where(angle < _SMALL_ANGLE_RAD, 0.0, c) * W @ W
    t = T_a_b[..., :3, 3:]
    return np.concatenate([omega, (V_inverse @ t)[..., 0]], axis=-1)


def adjoint(T_a_b: FloatArray) -> FloatArray:
    """Return the (..., 6, 6) matrices that take tangents in frame b to tangents in frame a."""
    matrix = np.zeros((*T_a_b.shape[:-2], 6, 6))
    R = T_a_b[..., :3, :3]
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = R
    matrix[..., 3:, :3] = skew(T_a_b[..., :3, 3]) @ R
    return matrix


def small_adjoint(tangent: FloatArray) -> FloatArray:
    """Return the (..., 6, 6) matrices of the Lie bracket with (..., 6) tangents."""
    matrix = np.zeros((*tangent.shape, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = skew(tangent[..., :3])
    matrix[..., 3:, :3] = skew(tangent[..., 3:])
    return matrix


def rotation_angle(T_a_b: FloatArray) -> FloatArray:
    """Return the rotation angle, rad, in [0, pi], of one transform or of a stack (N, 4, 4)."""
    R = T_a_b[..., :3, :3]
    sine = 0.5 * np.sqrt(
        (R[..., 2, 1] - R[..., 1, 2]) ** 2
        + (R[..., 0, 2] - R[..., 2, 0]) ** 2
        + (R[..., 1, 0] - R[..., 0, 1]) ** 2
    )
    return np.asarray(np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)))


def translation_norm(T_a_b: FloatArray) -> FloatArray:
    """Return the length of the translation, metres, of one transform or of a stack (N, 4, 4)."""
    return np.asarray(np.linalg.norm(T_a_b[..., :3, 3], axis=-1))


def pose_distance(T_world_a: FloatArray, T_world_b: FloatArray) -> float:
    """Return metres plus radians between two poses (eq. 10)."""
    T_a_b = inverse(T_world_a) @ T_world_b
    return float(np.linalg.norm(T_a_b[:3, 3]) + rotation_angle(T_a_b))


def to_quaternion(rotation: FloatArray) -> FloatArray:
    """Return the (..., 4) unit quaternions x y z w, w >= 0, of (..., 3, 3) rotations."""
    # Shepperd's method: of x, y, z and w the largest is found by itself, the others from it.
    R = np.moveaxis(rotation, (-2, -1), (0, 1))
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] + R[1, 2]
    by_each = np.array(
        [
            [1.0 + 2.0 * R[0, 0] - trace, xy, xz, x],
            [xy, 1.0 + 2.0 * R[1, 1] - trace, yz, y],
            [xz, yz, 1.0 + 2.0 * R[2, 2] - trace, z],
            [x, y, z, 1.0 + trace],
        ]
    )
    largest = np.argmax(np.stack([by_each[i, i] for i in range(4)]), axis=0)
    quaternion = np.take_along_axis(
        np.moveaxis(by_each, (0, 1), (-2, -1)), largest[..., None, None], axis=-2
    )[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.asarray(np.where(quaternion[..., 3:] >= 0.0, quaternion, -quaternion))


def from_quaternion(quaternion_xyzw: FloatArray) -> FloatArray:
    """Return the (..., 3, 3) rotations of (..., 4) quaternions x y z w of any non-zero length."""
    q = quaternion_xyzw / np.linalg.norm(quaternion_xyzw, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_between(a: FloatArray, b: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return the (3, 3) rotation that best takes (N, 3) vectors a to b (Kabsch), by (N,) weights.

    Vectors on a line leave it free in part: any of the best ones is returned.
    """
    weighted = b if weights is None else b * weights[:, None]
    U, _, Vt = np.linalg.svd(weighted.T @ a)
    # The last sign keeps it a rotation where a reflection would fit better.
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def mean_motion(T_from: FloatArray, T_to: FloatArray) -> FloatArray:
    """Return the (4, 4) motion that best takes (N, 4, 4) poses to others: turning, then ways."""
    axes = (T[:, :3, :3].swapaxes(1, 2).reshape(-1, 3) for T in (T_from, T_to))
    R = rotation_between(*axes)
    t = (T_to[:, :3, 3] - T_from[:, :3, 3] @ R.T).mean(axis=0)
    return from_rotation_translation(R, t)

# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as (4, 4) float64 matrices.

`T_a_b` takes coordinates in frame b to coordinates in frame a: `p_a = T_a_b @ p_b`, so
neighbouring letters cancel: `T_world_cam = T_world_odom @ T_odom_cam`. Tangent vectors are
`[rotation (rad); translation (m)]`, GTSAM's order. Quaternions are x y z w, TUM's order.
"""

import numpy as np

from slam.types import FloatArray

_SMALL_ANGLE_RAD = 1e-8


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
    """Return the (3, 3) matrix of the cross product with a (3,) vector, (N, 3, 3) of (N, 3)."""
    x, y, z = v.T
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


def exp(tangent: FloatArray) -> FloatArray:
    """Return the (4, 4) transform of a (6,) tangent [rotation rad; translation m]."""
    omega, v = tangent[:3], tangent[3:]
    angle = float(np.linalg.norm(omega))
    W = skew(omega)
    if angle < _SMALL_ANGLE_RAD:
        return from_rotation_translation(np.eye(3) + W, v + 0.5 * W @ v)
    a = np.sin(angle) / angle
    b = 2.0 * np.sin(0.5 * angle) ** 2 / angle**2  # (1 - cos) / angle^2 without cancellation
    c = (angle - np.sin(angle)) / angle**3
    rotation = np.eye(3) + a * W + b * W @ W
    return from_rotation_translation(rotation, (np.eye(3) + b * W + c * W @ W) @ v)


def log(T_a_b: FloatArray) -> FloatArray:
    """Return the (6,) tangent [rotation rad; translation m] of a (4, 4) transform."""
    # Through the quaternion: stays accurate near 180 degrees, where the trace formula does not.
    x, y, z, w = to_quaternion(T_a_b[:3, :3])
    vector = np.array([x, y, z])
    length = float(np.linalg.norm(vector))
    is_small = length < _SMALL_ANGLE_RAD
    omega = 2.0 * vector / w if is_small else 2.0 * np.arctan2(length, w) / length * vector
    angle = float(np.linalg.norm(omega))
    W = skew(omega)
    if angle < _SMALL_ANGLE_RAD:
        return np.concatenate([omega, T_a_b[:3, 3] - 0.5 * W @ T_a_b[:3, 3]])
    c = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle) + 1e-300)
    V_inverse = np.eye(3) - 0.5 * W + c * W @ W
    return np.concatenate([omega, V_inverse @ T_a_b[:3, 3]])


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


def to_quaternion(rotation: FloatArray) -> FloatArray:
    """Return the (4,) unit quaternion x y z w, w >= 0, of a (3, 3) rotation."""
    # Shepperd's method: the eigenvector of the largest eigenvalue of K is the quaternion.
    R = rotation
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], 0.0, 0.0, 0.0],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], 0.0, 0.0],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], 0.0],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)],
        ]
    )
    quaternion = np.asarray(np.linalg.eigh(K)[1][:, -1], dtype=np.float64)
    return quaternion if quaternion[3] >= 0.0 else -quaternion


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

# SPDX-License-Identifier: Apache-2.0
"""Where a camera sits on a body, from motions of both: the hand-eye equation.

The camera is rigid on the body. Whatever time passes, the camera's motion A and the body's B
satisfy T_base_cam A = B T_base_cam (Tsai and Lenz, 1989).
"""

from dataclasses import dataclass

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray

_ROUNDS, _ARRIVED = 40, 1e-9
_HINT = 0.1  # weight of translations before the lever arm is known
# A camera that goes round a circle and one that turns at the end of a long arm move alike.
_USUAL_ARM_M = 0.5
# Less is not worth a word, and less than so many standard deviations may be chance.
_WORTH_A_WORD_DEG, _WORTH_A_WORD_M, _SIGMAS = 2.0, 0.03, 4.0
_NEXT_TO_NOTHING = 1e-6  # of information


@dataclass(frozen=True)
class HandEye:
    """Where the camera sits, and how well that is known.

    Attributes:
        T_base_cam: (4, 4).
        scale: what the body's translations have to be multiplied by, metres per unit.
        misfit: what is left of the motions, as a share of them.
        unexplained: the share of the motions of which nearly nothing is explained.
        likeness: how alike both turn, -1 to 1, however noisy: their correlation.
        rotation_sigma_rad, arm_sigma_m, scale_sigma: standard deviations, 0 of what was given.
    """

    T_base_cam: FloatArray
    scale: float
    misfit: float
    unexplained: float
    likeness: float
    rotation_sigma_rad: float
    arm_sigma_m: float
    scale_sigma: float

    def tells_apart(self, T_frame_frame: FloatArray) -> bool:
        """Whether a (4, 4) motion between two frames is worth a word, and more than chance."""
        turned_deg = np.degrees(se3.rotation_angle(T_frame_frame))
        moved_m = se3.translation_norm(T_frame_frame)
        is_turned = turned_deg > max(
            _WORTH_A_WORD_DEG, _SIGMAS * np.degrees(self.rotation_sigma_rad)
        )
        return bool(is_turned or moved_m > max(_WORTH_A_WORD_M, _SIGMAS * self.arm_sigma_m))


def seven_numbers(T: FloatArray) -> str:
    """Return a (4, 4) transform as it is typed and told: tx ty tz qx qy qz qw."""
    numbers = np.array([*T[:3, 3], *se3.to_quaternion(T[:3, :3])]) + 0.0
    return " ".join(f"{value:.4f}" for value in numbers)


def solve_hand_eye(
    A: FloatArray,
    B: FloatArray,
    shares: FloatArray,
    T_base_cam: FloatArray | None = None,
    scale: float | None = None,
) -> HandEye:
    """Return where the camera sits by (N, 4, 4) motions A of the camera and B of the body.

    The (N,) shares say how much of a motion no other one tells too. A frame or a scale that is
    given is kept. All is solved for together, by Gauss-Newton steps with Cauchy's weights: where
    the body turns about one axis alone, as a robot on the floor does, rotations leave open how the
    camera is turned about that, and how it moves tells.
    """
    motions = _Motions(
        se3.log(A)[:, :3], se3.log(B)[:, :3], A[:, :3, 3], B[:, :3, 3], B[:, :3, :3] - np.eye(3)
    )
    R = motions.first_rotation() if T_base_cam is None else T_base_cam[:3, :3]
    arm = np.zeros(3) if T_base_cam is None else T_base_cam[:3, 3]
    factor = 1.0 if scale is None else scale
    free = np.array([*[T_base_cam is None] * 6, scale is None])
    covariance = np.zeros((7, 7))
    for _ in range(_ROUNDS if free.any() else 0):
        H, g = _equations(motions, R, arm, factor, shares)
        inverse = np.linalg.inv(H[np.ix_(free, free)])
        step = np.zeros(7)
        step[free] = -inverse @ g[free]
        covariance[np.ix_(free, free)] = inverse
        R = R @ se3.exp(np.concatenate([step[:3], np.zeros(3)]))[:3, :3]
        arm, factor = arm + step[3:6], factor + float(step[6])
        if np.abs(step).max() < _ARRIVED:
            break
    T = se3.from_rotation_translation(R, arm)
    sigmas = np.sqrt(covariance.diagonal())
    return HandEye(
        T,
        factor,
        misfit(A, B, T, factor),
        _unexplained(A, B, T, factor),
        _likeness(motions.camera_turns @ R.T, motions.body_turns, shares),
        float(sigmas[:3].max()),
        float(sigmas[3:6].max()),
        float(sigmas[6]),
    )


@dataclass(frozen=True)
class _Motions:
    """Motions of camera and body: (N, 3) turns, as rotation vectors, and ways; R_body - I."""

    camera_turns: FloatArray
    body_turns: FloatArray
    camera_ways: FloatArray
    body_ways: FloatArray
    body_turned: FloatArray

    def first_rotation(self) -> FloatArray:
        """Return about how the camera is turned, as if it sat where the body's poses are."""
        a, b, a_t, b_t = (
            v / max(float(np.median(np.linalg.norm(v, axis=1))), 1e-9)
            for v in (self.camera_turns, self.body_turns, self.camera_ways, self.body_ways)
        )
        weights = np.repeat([1.0, _HINT], len(a))
        return se3.rotation_between(np.concatenate([a, a_t]), np.concatenate([b, b_t]), weights)


def _equations(
    motions: _Motions, R: FloatArray, arm: FloatArray, scale: float, shares: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations (7, 7), (7,) of turning, arm and scale.

    Off are r_B - R r_A, and (R_B - I) arm + scale t_B - R t_A: R (I + [w]) v = R v - R [v] w.
    """
    off_r = motions.body_turns - motions.camera_turns @ R.T
    off_t = motions.body_turned @ arm + scale * motions.body_ways - motions.camera_ways @ R.T
    count = len(off_r)
    J_r, J_t = np.zeros((count, 3, 7)), np.zeros((count, 3, 7))
    J_r[:, :, :3], J_t[:, :, :3] = (
        R @ se3.skew(motions.camera_turns),
        R @ se3.skew(motions.camera_ways),
    )
    J_t[:, :, 3:6], J_t[:, :, 6] = motions.body_turned, motions.body_ways
    H, g = (
        np.diag([*[_NEXT_TO_NOTHING] * 3, *[_USUAL_ARM_M**-2.0] * 3, _NEXT_TO_NOTHING]),
        np.zeros(7),
    )
    g[3:6] = arm / _USUAL_ARM_M**2
    for off, J in ((off_r, J_r), (off_t, J_t)):
        size = np.linalg.norm(off, axis=1)
        spread = max(float(np.median(size)), 1e-6)
        weights = shares / (1.0 + (size / spread) ** 2) / spread**2
        weighted = weights[:, None, None] * J
        H += np.einsum("nij,nik->jk", weighted, J)
        g += np.einsum("nij,ni->j", weighted, off)
    return H, g


def misfit(A: FloatArray, B: FloatArray, T_base_cam: FloatArray, scale: float) -> float:
    """Return what is left of the motions, as a share of them: rotation and translation, a mean."""
    off = _off(A, B, T_base_cam, scale)
    share_r = np.median(se3.rotation_angle(off)) / np.median(se3.rotation_angle(A))
    share_t = np.median(se3.translation_norm(off)) / max(np.median(se3.translation_norm(A)), 1e-9)
    return float(0.5 * (share_r + share_t))


def _off(A: FloatArray, B: FloatArray, T_base_cam: FloatArray, scale: float) -> FloatArray:
    scaled = B.copy()
    scaled[:, :3, 3] *= scale
    return se3.inverse(A) @ se3.inverse(T_base_cam) @ scaled @ T_base_cam


def _unexplained(A: FloatArray, B: FloatArray, T_base_cam: FloatArray, scale: float) -> float:
    off_m = se3.translation_norm(_off(A, B, T_base_cam, scale))
    size_m = se3.translation_norm(A)
    moving = size_m > np.median(size_m)
    return float((off_m[moving] > 0.7 * size_m[moving]).mean()) if moving.any() else 0.0


def _likeness(a: FloatArray, b: FloatArray, shares: FloatArray) -> float:
    product, a_a, b_b = (
        float((shares * (x * y).sum(axis=1)).sum()) for x, y in ((a, b), (a, a), (b, b))
    )
    return product / max(float(np.sqrt(a_a * b_b)), 1e-12)

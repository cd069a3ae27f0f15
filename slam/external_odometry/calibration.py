# SPDX-License-Identifier: Apache-2.0
"""In which frame, clock and unit the poses of an odometry from elsewhere are: found by comparison.

The camera is rigid on the body that the odometry has poses of. Whatever time passes, its motion A
and the body's B satisfy A_base_cam A = B A_base_cam, the hand-eye equation (Tsai and Lenz, 1989):
rotations alone say how the camera is turned on the body and how late the clock is, translations
then where it sits and what the unit is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from slam.external_odometry.conventions import Convention
from slam.external_odometry.given_poses import poses_between
from slam.geometry import se3
from slam.types import FloatArray, Trajectory

_SPANS_S = (0.3, 1.0)  # motions over about so long are compared
_MIN_MOTIONS = 30
_MIN_TURN_RAD = np.radians(1.0)  # of a typical motion; less tells nothing of frame and clock
_LATEST_S, _COARSE_S, _FINE_S = 1.0, 0.02, 0.001
_ROUNDS = 8
# A reading of the poses that leaves this share of the motions is right; if the one asked for leaves
# more, another one has to explain them so much better.
_WELL, _CLEARLY = 0.15, 0.6
_HINT = 0.1  # weight of translations before the lever arm is known
_OVERLAPPING = 20.0  # motions that begin a frame apart share most of their errors
_MOST_OFF_RAD = np.radians(10.0)


@dataclass(frozen=True)
class Calibration:
    """How the poses fit the images best, and how well that is known.

    Attributes:
        convention: the reading under which they do.
        misfit: what is left of the motions under it, as a share of them, rotation and translation.
        misfit_before: the same under the reading that was asked for.
        rotation_sigma_rad, arm_sigma_m, scale_sigma: standard deviations of T_base_cam and scale.
    """

    convention: Convention
    misfit: float
    misfit_before: float
    rotation_sigma_rad: float
    arm_sigma_m: float
    scale_sigma: float


@dataclass(frozen=True)
class _Motions:
    """Motions of the camera as the images have them, and when they began and ended."""

    start_s: FloatArray
    end_s: FloatArray
    T_start_end: FloatArray

    @staticmethod
    def of(visual: Sequence[Trajectory]) -> "_Motions":
        parts = [_pairs(each, span_s) for each in visual for span_s in _SPANS_S if len(each) > 1]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return _Motions(*columns) if columns else _Motions(*[np.zeros(0)] * 3)

    def select(self, mask: FloatArray) -> "_Motions":
        return _Motions(self.start_s[mask], self.end_s[mask], self.T_start_end[mask])


def _pairs(visual: Trajectory, span_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    stamps_s, T = visual.timestamps_s, visual.T_world_cam
    first = np.arange(len(visual))
    second = np.maximum(np.searchsorted(stamps_s, stamps_s + span_s), first + 1)
    is_inside = second < len(visual)
    first, second = first[is_inside], second[is_inside]
    near = stamps_s[second] - stamps_s[first] < 2.0 * span_s
    first, second = first[near], second[near]
    return stamps_s[first], stamps_s[second], se3.inverse(T[first]) @ T[second]


def calibrate(
    visual: Sequence[Trajectory], given: Trajectory, asked: Convention
) -> Calibration | None:
    """Return the reading of given poses that fits the images best; None where too little is known.

    The visual trajectories are the camera's, each in a frame of its own. The reading asked for is
    the one returned unless another explains the motions clearly better, and its parts are those
    that fit best.
    """
    motions = _Motions.of(visual)
    if len(motions.start_s) < _MIN_MOTIONS or len(given) < _MIN_MOTIONS:
        return None
    turns = se3.rotation_angle(motions.T_start_end)
    if np.median(turns) < _MIN_TURN_RAD:
        return None
    as_asked = _fit(motions, given, asked)
    if as_asked is None or as_asked.misfit < _WELL:
        return as_asked
    inverted, w_first = not asked.is_inverted, not asked.is_w_first
    others = [
        replace(asked, is_inverted=inverted),
        replace(asked, is_w_first=w_first),
        replace(asked, is_inverted=inverted, is_w_first=w_first),
    ]
    fits = [fit for each in others if (fit := _fit(motions, given, each))]
    best = min(fits, key=lambda each: each.misfit, default=as_asked)
    chosen = best if best.misfit < _CLEARLY * as_asked.misfit else as_asked
    return replace(chosen, misfit_before=as_asked.misfit_before)


def _fit(motions: _Motions, given: Trajectory, reading: Convention) -> Calibration | None:
    """Return the best offset, frame and scale for one way to read rotations and direction."""
    plain = replace(reading, T_base_cam=np.eye(4), scale=1.0, time_offset_s=0.0)
    body = plain.body_poses(given)
    offset_s = _offset(motions, body)
    pair = _compared(motions, body, offset_s)
    if pair is None:
        return None
    A, B = pair
    T_base_cam, scale, sigmas = _hand_eye(A, B)
    before = _compared(motions, body, reading.time_offset_s)
    found = replace(plain, T_base_cam=T_base_cam, scale=scale, time_offset_s=offset_s)
    misfit_before = np.inf if before is None else _misfit(*before, reading)
    return Calibration(found, _misfit(A, B, found), misfit_before, *sigmas)


def _compared(
    motions: _Motions, body: Trajectory, offset_s: float
) -> tuple[FloatArray, FloatArray] | None:
    """Return (N, 4, 4) motions of the camera and of the body, where both are known."""
    start, end = (poses_between(body, each + offset_s) for each in (motions.start_s, motions.end_s))
    T_body = se3.inverse(start) @ end
    known = np.isfinite(T_body[:, 0, 0])
    if known.sum() < _MIN_MOTIONS:
        return None
    return motions.T_start_end[known], T_body[known]


def _offset(motions: _Motions, body: Trajectory) -> float:
    """Return how much later the body's stamps are, seconds, by what both say of turning."""
    turning = Slerp(body.timestamps_s, Rotation.from_matrix(body.T_world_cam[:, :3, :3]))
    camera = se3.log(motions.T_start_end)[:, :3]
    first_s, last_s = body.timestamps_s[[0, -1]]
    inside = (motions.start_s - _LATEST_S >= first_s) & (motions.end_s + _LATEST_S <= last_s)
    if inside.sum() < _MIN_MOTIONS:
        inside[:] = True

    def cost(offset_s: float) -> float:
        start_s, end_s = motions.start_s[inside] + offset_s, motions.end_s[inside] + offset_s
        known = (start_s >= first_s) & (end_s <= last_s)
        if known.sum() < _MIN_MOTIONS:
            return np.inf
        r_body = (turning(start_s[known]).inv() * turning(end_s[known])).as_rotvec()
        r_camera = camera[inside][known]
        R = _rotation(r_camera, r_body, np.ones(len(r_body)))
        off = np.linalg.norm(r_body - r_camera @ R.T, axis=1)
        return float(np.minimum(off, _MOST_OFF_RAD).mean())

    best_s = 0.0
    for reach_s, step_s in ((_LATEST_S, _COARSE_S), (_COARSE_S, 0.1 * _COARSE_S)):
        tried_s = best_s + np.arange(-reach_s, reach_s + 0.5 * step_s, step_s)
        costs = [cost(each) for each in tried_s]
        best = int(np.argmin(costs))
        best_s = float(tried_s[best])
    if 0 < best < len(costs) - 1:  # the lowest point of the parabola through the three lowest
        left, middle, right = costs[best - 1 : best + 2]
        curvature = left - 2.0 * middle + right
        if np.isfinite(curvature) and curvature > 0.0:
            best_s += 0.5 * step_s * (left - right) / curvature
    return round(best_s / _FINE_S) * _FINE_S


def _rotation(a: FloatArray, b: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation that best takes (N, 3) vectors a to b (Kabsch)."""
    U, _, Vt = np.linalg.svd((b * weights[:, None]).T @ a)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def _hand_eye(A: FloatArray, B: FloatArray) -> tuple[FloatArray, float, tuple[float, float, float]]:
    """Return T_base_cam (4, 4), the scale of B, and their standard deviations.

    By rotations and translations in turn, robustly: where the body turns about one axis alone, as a
    robot on the floor does, rotations leave open how the camera is turned about that axis, and how
    it moves tells.
    """
    r_A, r_B, t_A, t_B = se3.log(A)[:, :3], se3.log(B)[:, :3], A[:, :3, 3], B[:, :3, 3]
    by_r, by_t = (1.0 / max(float(np.median(np.linalg.norm(v, axis=1))), 1e-9) for v in (r_A, t_A))
    by_t_B = 1.0 / max(float(np.median(np.linalg.norm(t_B, axis=1))), 1e-9)
    R = _rotation(
        np.concatenate([r_A * by_r, t_A * by_t]),
        np.concatenate([r_B * by_r, t_B * by_t_B]),
        np.concatenate([np.ones(len(A)), np.full(len(A), _HINT)]),
    )
    weights_r = weights_t = np.ones(len(A))
    for _ in range(_ROUNDS):
        arm, scale, spread_t, covariance = _arm_and_scale(R, t_A, t_B, B, weights_t)
        moved = (B[:, :3, :3] - np.eye(3)) @ arm + scale * t_B
        off_r = np.linalg.norm(r_B - r_A @ R.T, axis=1)
        off_t = np.linalg.norm(moved - t_A @ R.T, axis=1)
        spread_r = max(float(np.median(off_r)), 1e-6)
        weights_r, weights_t = (
            1.0 / (1.0 + (off / spread) ** 2)
            for off, spread in ((off_r, spread_r), (off_t, spread_t))
        )
        R = _rotation(
            np.concatenate([r_A / spread_r, t_A / spread_t]),
            np.concatenate([r_B / spread_r, moved / spread_t]),
            np.concatenate([weights_r, weights_t]),
        )
    independent = len(A) / _OVERLAPPING
    turned = np.linalg.norm(r_A, axis=1)
    rotation_sigma = spread_r / max(float(np.sqrt((turned**2).mean() * independent)), 1e-9)
    arm_sigma = float(np.sqrt(_OVERLAPPING * covariance[:3, :3].diagonal().max()))
    scale_sigma = float(np.sqrt(_OVERLAPPING * covariance[3, 3]))
    T_base_cam = se3.from_rotation_translation(R, arm)
    return T_base_cam, scale, (rotation_sigma, arm_sigma, scale_sigma)


def _arm_and_scale(
    R: FloatArray, t_A: FloatArray, t_B: FloatArray, B: FloatArray, weights: FloatArray
) -> tuple[FloatArray, float, float, FloatArray]:
    """Return arm (3,), scale, what is left of translations, and the (4, 4) covariance of the four.

    They solve R t_A = (R_B - I) arm + scale t_B.
    """
    rows = np.concatenate([B[:, :3, :3] - np.eye(3), t_B[:, :, None]], axis=2)
    weighted = rows * weights[:, None, None]
    # What no motion tells of the arm, as its height on a robot on the floor, is taken to be zero.
    H = np.einsum("nij,nik->jk", weighted, rows) + 1e-6 * len(rows) * np.diag([1.0, 1.0, 1.0, 0.0])
    solved = np.linalg.solve(H, np.einsum("nij,ni->j", weighted, t_A @ R.T))
    off = np.linalg.norm(rows @ solved - t_A @ R.T, axis=1)
    spread = max(float(np.median(off)), 1e-6)
    return solved[:3], float(solved[3]), spread, np.linalg.inv(H) * spread**2


def _misfit(A: FloatArray, B: FloatArray, reading: Convention) -> float:
    """Return what is left of the motions, as a share of them: rotation and translation, a mean."""
    scaled, T_base_cam = B.copy(), reading.T_base_cam
    scaled[:, :3, 3] *= reading.scale
    off = se3.inverse(A) @ se3.inverse(T_base_cam) @ scaled @ T_base_cam
    share_r = np.median(se3.rotation_angle(off)) / np.median(se3.rotation_angle(A))
    share_t = np.median(se3.translation_norm(off)) / max(np.median(se3.translation_norm(A)), 1e-9)
    return float(0.5 * (share_r + share_t))

# SPDX-License-Identifier: Apache-2.0
"""The camera's true poses, of what came as ground truth, and what that cannot tell.

Motion capture has poses of a marker body, a robot has those of its base, each by a clock and in a
unit of its own. How the camera turned and moved by the images tells which body, clock and unit; it
has no say in where the path leads.
"""

from dataclasses import dataclass, replace

import numpy as np

from slam.evaluation.trajectory import align, associate
from slam.evaluation.truth_gaps import without_gaps
from slam.external_odometry.calibration import Calibration, calibrate
from slam.external_odometry.conventions import Convention
from slam.external_odometry.hand_eye import seven_numbers
from slam.geometry import se3
from slam.types import FloatArray, SlamError, Trajectory

# Of the estimate is looked at so many steps, of no more than so long, or pieces of so many.
_STEPS, _STEP_S, _PIECES, _PIECE = 100, 0.2, 10, 50
_OFFSET_S = 0.02  # of a clock that is worth a word
# Standard deviations with which a body is known well enough: of turning, and of the way that the
# camera makes on its arm when it turns, by no more than so much.
_KNOWN_DEG, _KNOWN_M, _MOST_TURNED = 1.0, 0.02, 2.0
# What is left of the motions, as a share of them: less is well, more has nothing to do with them;
# another reading than the usual leaves so much less. Correlation of turning that is of one body.
_WELL, _VAGUE, _CLEARLY, _ONE_BODY = 0.1, 0.3, 0.75, 0.9
_UNITS = ((0.001, 1.3, "millimetres"), (0.01, 1.3, "centimetres"), (0.0254, 1.05, "inches"))
_SCALE, _SCALE_OF_FEW = 0.03, 2.0  # of a path that is too long or short; by how many positions
# Of what is left where a path is aligned: a factor or a mirror that leaves less is real.
_HALF = 0.5
_POSITIONS_ALONE = "the ground truth has positions alone, no orientations"
_UNKNOWN_BODY = "the ground truth is of a body on which the camera's place is not known well"
_LEFT_HANDED = "its axes are mirrored, those of a left-handed world"
_STILL_M, _MOVING_M = 1e-6, 0.05
_STILL_DEG, _TURNING_DEG = 0.01, 5.0
_RATE_HZ, _ALIKE = 20.0, 0.7  # turning is compared so often, and has to correlate so much
_LONGEST_GAP_S, _SHORTEST_S = 0.5, 5.0
_HALF_TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
_MIN_MATCHED, _MIN_SCALED = 3, 15  # positions that an alignment needs, and a factor


@dataclass(frozen=True)
class CameraTruth:
    """True poses of the camera, and what is known of them.

    Attributes:
        trajectory: the poses, metres, at the images' times.
        doubts: what a user should know of them, one sentence each; none where they came as such.
        unjudged: why they cannot say how the camera turned, so that neither loops nor relative
            errors can be judged by them; empty where they can.
        scale: how many times as long as the true path the estimated one is; 1 where it is about
            as long.
    """

    trajectory: Trajectory
    doubts: tuple[str, ...] = ()
    unjudged: str = ""
    scale: float = 1.0


def camera_truth(estimate: Trajectory, truth: Trajectory, tolerance_s: float) -> CameraTruth:
    """Return the true poses of the camera of which there is an estimate, metres.

    Truth that fits as it is comes back as it is. The tolerance is of the association in time.

    Raises:
        SlamError: the ground truth has no pose that is one, or does not move where the camera does.
    """
    if len(truth) < _MIN_MATCHED or len(estimate) < _MIN_MATCHED:
        return CameraTruth(truth)
    known, doubts = without_gaps(truth, estimate)
    if _is_still(known) and not _is_still(estimate, _MOVING_M):
        raise SlamError(
            "the ground truth stays in one place, while the images show that the camera moves; is"
            " it the camera's?"
        )
    if _turned_deg(known) < _STILL_DEG and _turned_deg(estimate) > _TURNING_DEG:
        found = CameraTruth(known, (), _POSITIONS_ALONE)
    else:
        found = _read(estimate, known)
    placed = _placed(estimate, found, tolerance_s)
    return replace(placed, doubts=(*doubts, *placed.doubts))


def _is_still(trajectory: Trajectory, extent_m: float = _STILL_M) -> bool:
    return bool(np.ptp(trajectory.T_world_cam[:, :3, 3], axis=0).max(initial=0.0) < extent_m)


def _turned_deg(trajectory: Trajectory) -> float:
    R = trajectory.T_world_cam
    angles = se3.rotation_angle(se3.inverse(R[:1]) @ R)
    return float(np.degrees(angles.max(initial=0.0)))


def _read(estimate: Trajectory, known: Trajectory) -> CameraTruth:
    """Return the poses under the reading that fits the motions of the camera."""
    pieces = _pieces(estimate)
    best, words = calibrate(pieces, known, Convention()), list[str]()
    before = best.misfit_before if best else np.inf
    if best is None or min(best.misfit, best.misfit_before) > _WELL:
        mirrored = Trajectory(known.timestamps_s, _MIRROR @ known.T_world_cam @ _MIRROR)
        others = [(mirrored, Convention(), [_LEFT_HANDED])]
        offset_s = _clock(estimate, known)
        if offset_s is not None:
            others.append((known, Convention(time_offset_s=offset_s), []))
        for given, asked, said in others:
            found = calibrate(pieces, given, asked)
            if found and (best is None or found.misfit < _CLEARLY * best.misfit):
                best, known, words = found, given, said
        if best and words == [_LEFT_HANDED]:
            known, best = _mirrored_least(known, best)
    if best is None:
        return CameraTruth(known)
    if best.misfit > _VAGUE or best.hand_eye.likeness < _ONE_BODY:
        if before <= _VAGUE:
            return CameraTruth(known)
        reason = "the ground truth does not turn and move as the camera does, however it is read"
        return CameraTruth(known, (), reason)
    turned = min(float(np.radians(_turned_deg(estimate))), _MOST_TURNED)
    return _as_found(known, best, before, words, turned)


def _mirrored_least(known: Trajectory, found: Calibration) -> tuple[Trajectory, Calibration]:
    """Return the same with that axis mirrored for which the camera is turned least."""
    T_base_cam = found.convention.T_base_cam
    half_turns = [np.diag([*signs, 1.0]) for signs in _HALF_TURNS]
    least = min(half_turns, key=lambda each: float(se3.rotation_angle(each @ T_base_cam)))
    turned = Trajectory(known.timestamps_s, least @ known.T_world_cam @ least)
    convention = replace(found.convention, T_base_cam=least @ T_base_cam)
    return turned, replace(found, convention=convention)


def _pieces(estimate: Trajectory) -> list[Trajectory]:
    """Return so much of the estimate as tells how it moves, which on a long one is a part."""
    stamps_s = estimate.timestamps_s
    step_s = min(float(np.ptp(stamps_s)) / _STEPS, _STEP_S)
    steps = np.floor((stamps_s - stamps_s[:1]) / max(step_s, 1e-9) + 0.5)
    thinned = np.flatnonzero(np.diff(steps, prepend=-1.0) > 0.0)
    parts = [thinned]
    if len(thinned) > _PIECES * _PIECE:
        starts = np.linspace(0, len(thinned) - _PIECE, _PIECES).astype(int)
        parts = [thinned[start : start + _PIECE] for start in starts]
    return [Trajectory(stamps_s[part], estimate.T_world_cam[part]) for part in parts]


def _as_found(
    known: Trajectory, found: Calibration, before: float, words: list[str], turned: float
) -> CameraTruth:
    """Return the poses as they have to be read, with what differs from poses of the camera."""
    best, sigma_m = found.convention, found.hand_eye.arm_sigma_m
    sigma_deg = float(np.degrees(found.hand_eye.rotation_sigma_rad))
    unit, name = _unit(best.scale)
    T_base_cam = best.T_base_cam.copy()
    T_base_cam[:3, 3] *= unit / best.scale  # the truth's metres, of which the images' may differ
    turned_deg = float(np.degrees(se3.rotation_angle(T_base_cam)))
    arm_m = float(se3.translation_norm(T_base_cam))
    is_of_another = found.hand_eye.tells_apart(T_base_cam)
    is_known = sigma_deg <= _KNOWN_DEG and sigma_m * turned <= _KNOWN_M
    if not is_of_another and not is_known and found.misfit < _HALF * before:
        return CameraTruth(known, (), _UNKNOWN_BODY)
    words = list(words)
    if best.is_inverted:
        words.append("its poses take the world to the camera")
    if best.is_w_first:
        words.append("its quaternions are w x y z")
    if name:
        words.append(f"it is in {name}")
    offset_s = best.time_offset_s if abs(best.time_offset_s) > _OFFSET_S else 0.0
    if offset_s:
        late = "later" if offset_s > 0.0 else "earlier"
        words.append(f"its clock is {abs(offset_s):.3f} s {late} than the images'")
    if is_of_another:
        words.append(
            f"it is of a body on which the camera is turned by {turned_deg:.1f} deg and"
            f" {100.0 * arm_m:.1f} cm away (known to {sigma_deg:.1f} deg and {100.0 * sigma_m:.1f}"
            f" cm; tx ty tz qx qy qz qw: {seven_numbers(T_base_cam)})"
        )
    if not words or found.misfit > _CLEARLY * before:
        return CameraTruth(known)
    said = f"the ground truth is not the camera's as it stands: {'; '.join(words)}"
    if not is_of_another or not is_known:
        T_base_cam = np.eye(4)
    used = replace(best, T_base_cam=T_base_cam, scale=unit, time_offset_s=offset_s)
    if is_of_another and not is_known:
        return CameraTruth(used.camera_poses(known), (said,), _UNKNOWN_BODY)
    return CameraTruth(used.camera_poses(known), (f"{said}; it was compared with as the camera's",))


def _unit(scale: float) -> tuple[float, str]:
    """Return the unit that a scale is about, metres, and its name, which metres have none of."""
    for unit, reach, name in _UNITS:
        if 1.0 / reach < scale / unit < reach:
            return unit, name
    return 1.0, ""


def _clock(estimate: Trajectory, known: Trajectory) -> float | None:
    """Return how much later than the images' the truth's clock is, by how fast both turn."""
    from scipy.signal import correlate  # takes half a second to load, and few truths need it

    (start_s, turning), (other_s, other) = _turning(estimate), _turning(known)
    shortest = min(len(turning), len(other))
    if shortest < _SHORTEST_S * _RATE_HZ:
        return None
    products = correlate(other, turning)
    ones = np.ones(len(turning)), np.ones(len(other))
    energies = correlate(other**2, ones[0]), correlate(ones[1], turning**2)
    overlaps = correlate(ones[1], ones[0])
    norms = np.sqrt(np.maximum(energies[0] * energies[1], 1e-12))
    scores = np.where(overlaps > _HALF * shortest, products / norms, -1.0)
    peak = int(np.argmax(scores))
    if scores[peak] < _ALIKE:
        return None
    return float(other_s - start_s + (peak - len(turning) + 1) / _RATE_HZ)


def _turning(trajectory: Trajectory) -> tuple[float, FloatArray]:
    """Return when it begins, and how fast it turns from then on, less the mean; 0 over gaps."""
    stamps_s, T = trajectory.timestamps_s, trajectory.T_world_cam
    if len(trajectory) < _MIN_MATCHED:
        return 0.0, np.zeros(0)
    every = max(int(1.0 / _RATE_HZ / np.median(np.diff(stamps_s))), 1)
    stamps_s, T = stamps_s[::every], T[::every]
    steps_s = np.diff(stamps_s)
    rates = se3.rotation_angle(se3.inverse(T[:-1]) @ T[1:]) / steps_s
    times_s = np.arange(stamps_s[0], min(stamps_s[-1], stamps_s[0] + 1e4), 1.0 / _RATE_HZ)
    step = np.clip(np.searchsorted(stamps_s, times_s, side="right") - 1, 0, len(rates) - 1)
    is_known = steps_s[step] <= _LONGEST_GAP_S
    sampled = rates[step]
    mean = float(sampled[is_known].mean()) if is_known.any() else 0.0
    return float(stamps_s[0]), np.where(is_known, sampled - mean, 0.0)


def _placed(estimate: Trajectory, found: CameraTruth, tolerance_s: float) -> CameraTruth:
    """Return the same with what the positions tell: the unit, a mirror, a factor between paths."""
    in_estimate, in_truth = associate(estimate, found.trajectory, tolerance_s)
    if len(in_estimate) < _MIN_MATCHED:
        return found
    path_m = estimate.T_world_cam[in_estimate, :3, 3]
    true_m = found.trajectory.T_world_cam[in_truth, :3, 3]
    rigid, similar, mirrored = _fit(path_m, true_m)
    T = found.trajectory.T_world_cam
    doubts, unjudged = list(found.doubts), found.unjudged
    if mirrored.left_m < _HALF * similar.left_m and similar.left_m > _SCALE * mirrored.extent_m:
        T, similar = _MIRROR @ T, mirrored
        unjudged = "the positions of the ground truth are mirrored, its orientations are not"
        T = np.concatenate([T[:, :, :3] @ _MIRROR[:3, :3], T[:, :, 3:]], axis=2)
    unit, name = _unit(similar.scale)
    if name and similar.left_m < _HALF * similar.extent_m:
        doubts.append(f"the ground truth is in {name}; it was compared with in metres")
    else:
        unit = 1.0
    if unjudged:
        doubts.append(f"{unjudged}; it cannot say whether loops are right, nor relative errors")
    scale = similar.scale / unit
    least = _SCALE + _SCALE_OF_FEW / len(path_m)
    is_off = abs(scale - 1.0) > least and similar.left_m < _HALF * rigid.left_m
    is_off &= similar.left_m < _HALF * similar.extent_m and len(path_m) >= _MIN_SCALED
    is_off &= unjudged in ("", _POSITIONS_ALONE)
    trajectory = Trajectory(found.trajectory.timestamps_s, T).enlarged(unit)
    return CameraTruth(trajectory, tuple(doubts), unjudged, scale if is_off else 1.0)


@dataclass(frozen=True)
class _Alignment:
    """How a path lies on a true one: times as large, what is left, and how far it extends."""

    scale: float
    left_m: float
    extent_m: float


def _fit(path_m: FloatArray, true_m: FloatArray) -> tuple[_Alignment, _Alignment, _Alignment]:
    """Return the alignments of (N, 3) positions: rigid, with a scale, with a scale and a mirror."""
    mirrored_m = true_m * _MIRROR.diagonal()[:3]
    size_m = np.sqrt(((path_m - path_m.mean(axis=0)) ** 2).sum(axis=1).mean())

    def fit(points_m: FloatArray, *, is_scaled: bool) -> _Alignment:
        aligned_m = se3.transform(align(points_m, path_m), points_m)
        centre_m = path_m.mean(axis=0)
        spread = max(float(((aligned_m - centre_m) ** 2).sum()), 1e-300)
        scale = float(((aligned_m - centre_m) * (path_m - centre_m)).sum()) / spread
        scale = scale if is_scaled else 1.0
        left_m = path_m - centre_m - scale * (aligned_m - centre_m)
        return _Alignment(scale, float(np.sqrt((left_m**2).sum(axis=1).mean())), float(size_m))

    return (
        fit(true_m, is_scaled=False),
        fit(true_m, is_scaled=True),
        fit(mirrored_m, is_scaled=True),
    )

# SPDX-License-Identifier: Apache-2.0
"""In which frame, clock and unit the poses of an odometry from elsewhere are: found by comparison.

The motions of the camera, as the images have them, are those of the body that the odometry has
poses of, seen from another place on it. Turning alone tells how late the clock is, the rest
follows from the hand-eye equation. Of several readings the simplest is taken that fits about as
well as the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.external_odometry.conventions import Convention
from slam.external_odometry.given_poses import poses_between
from slam.external_odometry.hand_eye import HandEye, misfit, solve_hand_eye
from slam.geometry import se3
from slam.types import FloatArray, Trajectory

_SPANS_S = (0.3, 1.0, 3.0)  # motions over about so long are compared
_MIN_MOTIONS = 30
_MIN_TURN_RAD = np.radians(1.0)  # of a typical motion; less tells nothing of frame and clock
_LATEST_S, _COARSE_S, _FINE_S = 1.0, 0.02, 0.001
# A reading that leaves no more than this share of the motions is right. Where the one asked for
# leaves more, another direction or order of quaternions has to leave so much less.
_WELL, _CLEARLY = 0.15, 0.6
_ABOUT_AS_WELL, _ABOUT = 1.25, 0.005  # what a simpler reading may leave more
_SAME_CLOCK = 1.15  # and the clock that was asked for
_KNOWN = 10.0  # standard deviations that a scale is above zero
# A scale is another than the one asked for, however well that fits, if it is so far from it, as a
# share of it, and by so many standard deviations, as noise makes scales too small.
_OTHER, _OTHER_SIGMAS = 0.03, 6.0
_MOST_OFF_RAD = np.radians(10.0)


@dataclass(frozen=True)
class Calibration:
    """How the poses fit the images, and how well that is known.

    Attributes:
        convention: the reading under which they do.
        hand_eye: how well; its frame and scale are the convention's.
        misfit_before: what is left of the motions under the reading that was asked for.
        ends: how well the first and the last quarter of the run do, each with a scale of its own;
            these and the sides are told by `with_parts`.
        sides: the two parts of the run that do best, each with a frame and a scale of its own.
            Either is empty where one of the two is too short to be compared.
        misfit_of_sides: what is left of the motions of the worse side under the one frame of the
            three that leaves least.
    """

    convention: Convention
    hand_eye: HandEye
    misfit_before: float
    ends: tuple[HandEye, ...] = ()
    sides: tuple[HandEye, ...] = ()
    misfit_of_sides: float = 0.0

    @property
    def misfit(self) -> float:
        """What is left of the motions, as a share of them."""
        return self.hand_eye.misfit


@dataclass(frozen=True)
class _Motions:
    """Motions of the camera as the images have them, and when they began and ended.

    Those that begin a frame apart share most of their errors: the share of a motion counts that.
    """

    start_s: FloatArray
    end_s: FloatArray
    T_start_end: FloatArray
    shares: FloatArray

    @staticmethod
    def of(visual: Sequence[Trajectory]) -> "_Motions":
        parts = [_pairs(each, span_s) for each in visual for span_s in _SPANS_S if len(each) > 1]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return _Motions(*columns) if columns else _Motions(*[np.zeros(0)] * 4)

    @property
    def quarters_s(self) -> list[float]:
        """When the run begins, is a quarter over, and so on until its end."""
        return [float(each) for each in np.linspace(self.start_s.min(), self.end_s.max(), 5)]

    def between(self, start_s: float, end_s: float) -> "_Motions":
        """Return those that neither begin before nor end after two times."""
        inside = (self.start_s >= start_s) & (self.end_s <= end_s)
        every = (self.start_s, self.end_s, self.T_start_end, self.shares)
        return _Motions(*(each[inside] for each in every))


def _pairs(visual: Trajectory, span_s: float) -> tuple[FloatArray, ...]:
    stamps_s, T = visual.timestamps_s, visual.T_world_cam
    first = np.arange(len(visual))
    second = np.maximum(np.searchsorted(stamps_s, stamps_s + span_s), first + 1)
    is_inside = second < len(visual)
    first, second = first[is_inside], second[is_inside]
    near = stamps_s[second] - stamps_s[first] < 2.0 * span_s
    first, second = first[near], second[near]
    shares = 1.0 / (second - first)
    return stamps_s[first], stamps_s[second], se3.inverse(T[first]) @ T[second], shares


def calibrate(
    visual: Sequence[Trajectory], given: Trajectory, asked: Convention
) -> Calibration | None:
    """Return the reading of given poses that fits the images; None where too little is known.

    The visual trajectories are the camera's, each in a frame of its own. What was asked for is
    returned, whole or in part, unless something else fits clearly better. What parts of the run
    say each on its own is left to `with_parts`.
    """
    motions = _Motions.of(visual)
    if len(motions.start_s) < _MIN_MOTIONS or len(given) < _MIN_MOTIONS:
        return None
    if np.median(se3.rotation_angle(motions.T_start_end)) < _MIN_TURN_RAD:
        return None
    pair = _compared(motions, _plain(asked).body_poses(given), asked.time_offset_s)
    before = misfit(*pair[:2], asked.T_base_cam, asked.scale) if pair else np.inf
    inverted, w_first = not asked.is_inverted, not asked.is_w_first
    readings = [
        asked,
        replace(asked, is_inverted=inverted),
        replace(asked, is_w_first=w_first),
        replace(asked, is_inverted=inverted, is_w_first=w_first),
    ]
    found = [_fit(motions, given, each) for each in readings[: 1 if before < _WELL else None]]
    fits = [replace(each, misfit_before=before) for each in found if each]
    best = min(fits, key=lambda each: each.misfit, default=None)
    if best and found[0] and best.misfit > _CLEARLY * fits[0].misfit:
        best = fits[0]
    return best


def with_parts(
    found: Calibration, visual: Sequence[Trajectory], given: Trajectory, asked: Convention
) -> Calibration:
    """Return what was found with what parts of the run say each on its own: `ends` and `sides`."""
    motions = _Motions.of(visual)
    return _with_sides(_with_ends(found, motions, given), motions, given, asked)


def _with_ends(found: Calibration, motions: _Motions, given: Trajectory) -> Calibration:
    reading = found.convention
    first_s, early_s, _, late_s, last_s = motions.quarters_s
    pairs = _pairs_of(motions, given, reading, (first_s, early_s), (late_s, last_s))
    return replace(found, ends=tuple(solve_hand_eye(*each, reading.T_base_cam) for each in pairs))


def _with_sides(
    found: Calibration, motions: _Motions, given: Trajectory, asked: Convention
) -> Calibration:
    first_s, *splits_s, last_s = motions.quarters_s
    splits = [_pairs_of(motions, given, asked, (first_s, s), (s, last_s)) for s in splits_s]
    tried = [(pairs, tuple(solve_hand_eye(*pair) for pair in pairs)) for pairs in splits if pairs]
    if not tried:
        return found
    pairs, sides = min(tried, key=lambda each: max(side.misfit for side in each[1]))
    as_one = min(
        max(misfit(*pair[:2], each.T_base_cam, each.scale) for pair in pairs)
        for each in (found.hand_eye, *sides)
    )
    return replace(found, sides=sides, misfit_of_sides=as_one)


def _pairs_of(
    motions: _Motions, given: Trajectory, reading: Convention, *parts: tuple[float, float]
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return what can be compared between times, for each part; none if one has too little."""
    body = _plain(reading).body_poses(given)
    pairs = [_compared(motions.between(*each), body, reading.time_offset_s) for each in parts]
    return [each for each in pairs if each] if all(pairs) else []


def _plain(reading: Convention) -> Convention:
    return replace(reading, T_base_cam=np.eye(4), scale=1.0, time_offset_s=0.0)


def _fit(motions: _Motions, given: Trajectory, reading: Convention) -> Calibration | None:
    """Return clock, frame and unit for one way to read rotations and direction."""
    body = _plain(reading).body_poses(given)
    offset_s = _offset(motions, body, reading.time_offset_s)
    pair = _compared(motions, body, offset_s)
    if pair is None:
        return None
    solutions = []
    for T_base_cam in (reading.T_base_cam, None):
        in_unit, free = (solve_hand_eye(*pair, T_base_cam, unit) for unit in (reading.scale, None))
        solutions += [free] if _is_another_scale(free, reading.scale) else [in_unit, free]
    solutions = [each for each in solutions if _is_known(each)]
    least = min((each.misfit for each in solutions), default=np.inf)
    for solution in solutions:  # the simplest come first
        if solution.misfit <= _ABOUT_AS_WELL * least + _ABOUT:
            if _fits_as_asked(motions, body, reading.time_offset_s, solution):
                offset_s = reading.time_offset_s
            found = replace(reading, T_base_cam=solution.T_base_cam, scale=solution.scale)
            return Calibration(replace(found, time_offset_s=offset_s), solution, np.inf)
    return None


def _is_known(found: HandEye) -> bool:
    return found.scale > _KNOWN * found.scale_sigma


def _is_another_scale(found: HandEye, asked: float) -> bool:
    """Whether a scale that was solved for is certainly not the one that was asked for."""
    by_chance = max(_OTHER * asked, _OTHER_SIGMAS * found.scale_sigma)
    return _is_known(found) and abs(found.scale - asked) > by_chance


def _fits_as_asked(motions: _Motions, body: Trajectory, asked_s: float, solution: HandEye) -> bool:
    """Whether the offset that was asked for does about as well as the one that was found."""
    pair = _compared(motions, body, asked_s)
    if pair is None:
        return False
    left = misfit(*pair[:2], solution.T_base_cam, solution.scale)
    return left <= _SAME_CLOCK * solution.misfit + _ABOUT


def _compared(
    motions: _Motions, body: Trajectory, offset_s: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return (N, 4, 4) motions of the camera and of the body, where both are known, and shares."""
    start, end = (poses_between(body, each + offset_s) for each in (motions.start_s, motions.end_s))
    T_body = se3.inverse(start) @ end
    known = np.isfinite(T_body[:, 0, 0])
    if known.sum() < _MIN_MOTIONS:
        return None
    return motions.T_start_end[known], T_body[known], motions.shares[known]


def _offset(motions: _Motions, body: Trajectory, about_s: float) -> float:
    """Return how much later the body's stamps are, about so many seconds, by what both turn."""
    from scipy.spatial.transform import Rotation, Slerp  # takes long to load, and few need it

    turning = Slerp(body.timestamps_s, Rotation.from_matrix(body.T_world_cam[:, :3, :3]))
    camera = se3.log(motions.T_start_end)[:, :3]
    first_s, last_s = body.timestamps_s[[0, -1]]
    inside = motions.start_s + about_s - _LATEST_S >= first_s
    inside &= motions.end_s + about_s + _LATEST_S <= last_s
    if inside.sum() < _MIN_MOTIONS:
        inside[:] = True

    def cost(offset_s: float) -> float:
        start_s, end_s = motions.start_s[inside] + offset_s, motions.end_s[inside] + offset_s
        known = (start_s >= first_s) & (end_s <= last_s)
        if known.sum() < _MIN_MOTIONS:
            return np.inf
        r_body = (turning(start_s[known]).inv() * turning(end_s[known])).as_rotvec()
        r_camera = camera[inside][known]
        R = se3.rotation_between(r_camera, r_body)
        off = np.linalg.norm(r_body - r_camera @ R.T, axis=1)
        return float(np.minimum(off, _MOST_OFF_RAD).mean())

    best_s = about_s
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

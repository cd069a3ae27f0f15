# SPDX-License-Identifier: Apache-2.0
"""Steps in a trajectory that no camera makes: what a wrong motion in the map leaves behind."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray, IntArray, Trajectory

_LONGEST_S = 0.25  # of a step; over a longer time without a frame nothing is known of the motion
_SIDE_S = 0.1  # the motion before and after a step is averaged over so long
# What a hand that is quick does to a camera at most. The truth of fr1_desk and fr1_xyz stays below
# half of it.
_ACCELERATION_M_S2 = 8.0
_TURNING_RAD_S2 = 100.0
# And a step stands out from what the same camera does around it: one that runs, or vibrates, does
# the like all the time.
_TIMES_USUAL = 4.0
_USUAL_SHARE = 0.9  # of what it does is no more than usual
_AROUND_S = 2.0
_MIN_AROUND = 8
_MOST_NAMED = 3


class _Step(NamedTuple):
    ratio: float  # to what is allowed
    start_s: float
    end_s: float
    size: float
    is_turn: bool

    @property
    def words(self) -> str:
        size = f"{np.rad2deg(self.size):.0f} degrees" if self.is_turn else f"{self.size:.2f} m"
        return (
            f"the camera seems to jump by {size} between {self.start_s:.3f} s and"
            f" {self.end_s:.3f} s: what was tracked before and after may not fit together"
        )


def impossible_steps(
    trajectory: Trajectory, session_starts_s: Sequence[float] | FloatArray = ()
) -> tuple[str, ...]:
    """Return a sentence for each of the largest steps that no camera makes, in the order of time.

    A step leads, within a quarter of a second, elsewhere than the motion before and after it. Where
    a session starts the camera may be anywhere.
    """
    times_s = trajectory.timestamps_s
    is_break = np.diff(times_s) > _LONGEST_S
    is_break |= np.diff(np.searchsorted(session_starts_s, times_s, side="right")) > 0
    found: list[_Step] = []
    for part in np.split(np.arange(len(times_s)), np.flatnonzero(is_break) + 1):
        if len(part) > _MIN_AROUND:
            found += _apart(_steps_and_turns(times_s[part], trajectory.T_world_cam[part]))
    largest = sorted(sorted(found)[-_MOST_NAMED:], key=lambda step: step.start_s)
    sentences = [step.words for step in largest]
    if len(found) > _MOST_NAMED:
        sentences[-1] += f"; {len(found) - _MOST_NAMED} smaller jumps are not named"
    return tuple(sentences)


def _steps_and_turns(times_s: FloatArray, T_world_cam: FloatArray) -> list[_Step]:
    turns = se3.log(T_world_cam[1:] @ se3.inverse(T_world_cam[:-1]))[:, :3]
    turned_rad = np.concatenate([np.zeros((1, 3)), np.cumsum(turns, axis=0)])
    return [
        *_steps(times_s, T_world_cam[:, :3, 3], _ACCELERATION_M_S2, is_turn=False),
        *_steps(times_s, turned_rad, _TURNING_RAD_S2, is_turn=True),
    ]


def _apart(steps: list[_Step]) -> list[_Step]:
    """Return those that are not beside a larger one, whose doing they are."""
    kept: list[_Step] = []
    for step in sorted(steps, reverse=True):
        begin_s, end_s = step.start_s - 2 * _LONGEST_S, step.end_s + 2 * _LONGEST_S
        if all(each.end_s < begin_s or each.start_s > end_s for each in kept):
            kept.append(step)
    return kept


def _steps(
    times_s: FloatArray, way: FloatArray, acceleration: float, *, is_turn: bool
) -> list[_Step]:
    """Return the steps, of whatever length, of an (N, 3) way.

    A step is what remains of the way between two frames once a velocity between those before and
    after is taken off, the one that leaves least: starting, stopping and turning back leave little.
    """
    frames = np.arange(len(times_s))
    before = np.minimum(np.searchsorted(times_s, times_s - _SIDE_S, side="right") - 1, frames - 1)
    after = np.maximum(np.searchsorted(times_s, times_s + _SIDE_S), frames + 1)
    interval_s = float(np.median(np.diff(times_s)))
    steps = []
    for length in range(1, len(times_s)):
        first, last = frames[:-length], frames[length:]
        is_judged = times_s[last] - times_s[first] <= _LONGEST_S
        if not is_judged.any():
            break
        is_judged &= (before[first] >= 0) & (after[last] < len(times_s))
        first, last = first[is_judged], last[is_judged]
        starts, ends = before[first], after[last]
        # Frames may be stamped as they arrive, late or in a burst, but were taken one by one.
        stamped_s, usual_s = times_s[last] - times_s[first], length * interval_s
        way_there = way[last] - way[first]
        velocities = _velocity(times_s, way, starts, first), _velocity(times_s, way, last, ends)
        size = np.minimum(
            _distance(way_there, *(stamped_s[:, None] * each for each in velocities)),
            _distance(way_there, *(usual_s * each for each in velocities)),
        )
        duration_s = np.maximum(stamped_s, usual_s)
        side_s = np.maximum(times_s[first] - times_s[starts], times_s[ends] - times_s[last])
        possible = acceleration * duration_s * (0.25 * duration_s + 0.5 * side_s)
        for i in np.flatnonzero(size > possible):
            apart_s = np.abs(times_s[first] - times_s[first[i]])
            is_beside = (apart_s <= _AROUND_S) & (apart_s > duration_s[i] + 2 * side_s[i])
            if is_beside.sum() < _MIN_AROUND:
                continue
            usual = _TIMES_USUAL * np.quantile(size[is_beside], _USUAL_SHARE)
            ratio = float(size[i] / max(possible[i], usual))
            if ratio > 1.0:
                start_s, end_s = float(times_s[first[i]]), float(times_s[last[i]])
                steps.append(_Step(ratio, start_s, end_s, float(size[i]), is_turn))
    return steps


def _velocity(times_s: FloatArray, way: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
    duration_s = times_s[last] - times_s[first]
    return np.asarray((way[last] - way[first]) / duration_s[:, None])


def _distance(points: FloatArray, starts: FloatArray, ends: FloatArray) -> FloatArray:
    """Return the (N,) distances of (N, 3) points to the lines from (N, 3) starts to ends."""
    along = ends - starts
    squared = np.maximum(np.einsum("nd,nd->n", along, along), 1e-12)
    share = np.clip(np.einsum("nd,nd->n", points - starts, along) / squared, 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - starts - share[:, None] * along, axis=1))

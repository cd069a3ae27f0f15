# SPDX-License-Identifier: Apache-2.0
"""Poses in ground truth that are none: what trackers write of what they do not see."""

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.trajectory import placeable
from slam.geometry import se3
from slam.types import FloatArray, SlamError, Trajectory

# A pose that is so much off the one before and the one after, which are so near in time and agree.
_LEAP_M, _LEAP_RAD, _NEAR_S, _TO_AND_FRO = 0.1, np.radians(10.0), 0.05, 5.0
# Poses that stay the same to the last digit, so many of them, while the camera moves or turns.
_HELD, _MOVED_M, _TURNED_RAD = 3, 0.05, np.radians(5.0)


def without_gaps(truth: Trajectory, estimate: Trajectory) -> tuple[Trajectory, tuple[str, ...]]:
    """Return the poses that are some, and a sentence for each kind of those that are none.

    Raises:
        SlamError: there is none at all in numbers that a place can have.
    """
    is_there = placeable(truth)
    if not is_there.any():
        raise SlamError("the ground truth holds no poses in numbers that a place can have")
    doubts = []
    for what, find in (
        ("are in no numbers that a place can have", lambda _: ~is_there),
        ("stay the same while the camera moves", lambda each: _held(each, estimate)),
        ("leap to and fro", _leaping),
    ):
        is_gap = find(truth)
        if is_gap.any() and not is_gap.all():
            count = f"{int(is_gap.sum())} of {len(truth)} true poses"
            doubts.append(f"{count} {what}; they are gaps in the ground truth")
            truth = Trajectory(truth.timestamps_s[~is_gap], truth.T_world_cam[~is_gap])
    return truth, tuple(doubts)


def _leaping(truth: Trajectory) -> NDArray[np.bool_]:
    is_gap = np.zeros(len(truth), dtype=np.bool_)
    if len(truth) < 3:
        return is_gap
    T, steps_s = truth.T_world_cam, np.diff(truth.timestamps_s)
    (to_m, to_rad), (over_m, over_rad) = _sizes(T[:-1], T[1:]), _sizes(T[:-2], T[2:])
    is_near = np.maximum(steps_s[:-1], steps_s[1:]) <= _NEAR_S
    for to, over, least in ((to_m, over_m, _LEAP_M), (to_rad, over_rad, _LEAP_RAD)):
        smaller = np.minimum(to[:-1], to[1:])
        is_gap[1:-1] |= is_near & (smaller > np.maximum(_TO_AND_FRO * over, least))
    return is_gap


def _held(truth: Trajectory, estimate: Trajectory) -> NDArray[np.bool_]:
    is_gap = np.zeros(len(truth), dtype=np.bool_)
    is_same = (np.diff(truth.T_world_cam, axis=0) == 0.0).all(axis=(1, 2))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_same, [False]]).astype(np.int8)))
    for first, last in edges.reshape(-1, 2):
        if last - first + 1 < _HELD or last - first + 1 == len(truth):
            continue
        span_s = truth.timestamps_s[[first, last]]
        start, end = np.searchsorted(estimate.timestamps_s, span_s)
        moved = estimate.T_world_cam[start:end]
        if len(moved) < 2:
            continue
        sizes_m, angles_rad = _sizes(moved[:1], moved)
        if sizes_m.max() > _MOVED_M or angles_rad.max() > _TURNED_RAD:
            is_gap[first : last + 1] = True
    return is_gap


def _sizes(T_world_a: FloatArray, T_world_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    T_a_b = se3.inverse(T_world_a) @ T_world_b
    return se3.translation_norm(T_a_b), se3.rotation_angle(T_a_b)

# SPDX-License-Identifier: Apache-2.0
"""Errors of poses that belong together: of their positions, their rotations, and their motions."""

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from placerec.datasets.tum_lists import nearest
from slam.geometry import se3
from slam.types import FloatArray, IntArray, SlamError

_DELTA = re.compile(r"(\d+\.?\d*|\.\d+) ?(m|s|f)")
_OFF = 0.1  # of a distance, that all pairs may be longer or shorter by
_LEAST, _MOST = 1e-6, 1e6  # of a delta


@dataclass(frozen=True)
class Delta:
    """What the two poses of a relative error are apart.

    Attributes:
        amount: in the unit.
        unit: m of the way between them, s of time, or f for frames, which are poses.
    """

    amount: float
    unit: str

    def __str__(self) -> str:
        return f"{self.amount:g} {self.unit}"


def read_deltas(text: str) -> tuple[Delta, ...]:
    """Return the deltas of a list such as `1m,5m,1s,10f`, each once.

    Raises:
        SlamError: it is no such list.
    """
    found = []
    for part in text.split(","):
        match = _DELTA.fullmatch(part.strip())
        amount = float(match[1]) if match else 0.0
        is_whole = amount == int(amount) if match else False
        if not match or not _LEAST <= amount <= _MOST or (match[2] == "f" and not is_whole):
            raise SlamError(
                f"{part!r} is no distance of two poses; give metres, seconds or a number of frames,"
                " such as 1m,5m,1s,10f"
            )
        found.append(Delta(amount, match[2]))
    return tuple(dict.fromkeys(found))


class Pairs(NamedTuple):
    """(P,) indices of the first and of the second pose of each pair."""

    first: IntArray
    second: IntArray


def pairs_in_time(stamps_s: FloatArray, interval_s: float, tolerance_s: float) -> Pairs:
    """Return every pose with the one that is nearest to so much later, if within a tolerance."""
    first, second = np.arange(len(stamps_s)), nearest(stamps_s, stamps_s + interval_s)
    is_pair = np.abs(stamps_s[second] - stamps_s - interval_s) <= tolerance_s
    is_pair &= second > first
    return Pairs(first[is_pair], second[is_pair])


def pairs_of_frames(count: int, frames: int, *, all_pairs: bool) -> Pairs:
    """Return poses that are so many apart: each with a later one, or one pair after the other."""
    first = np.arange(0, count, 1 if all_pairs else frames)
    return Pairs(first[first + frames < count], first[first + frames < count] + frames)


def pairs_along(positions_m: FloatArray, distance_m: float, *, all_pairs: bool) -> Pairs:
    """Return poses that are so far apart on the way through (N, 3) positions.

    One pair begins where the one before ends, and ends at the first pose that is far enough on. Of
    all pairs each begins at a pose of its own and ends where the distance is met best, if it is
    met to a tenth.
    """
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    if all_pairs:
        return _all_along(np.concatenate([[0.0], np.cumsum(steps_m)]), distance_m)
    ends, way_m = [0], 0.0
    for i, step_m in enumerate(steps_m.tolist(), start=1):
        way_m += step_m
        if way_m >= distance_m:
            ends.append(i)
            way_m = 0.0
    return Pairs(np.array(ends[:-1], np.int64), np.array(ends[1:], np.int64))


def _all_along(way_m: FloatArray, distance_m: float) -> Pairs:
    first = np.arange(len(way_m) - 1)
    target_m = way_m[first] + distance_m
    above = np.minimum(np.searchsorted(way_m, target_m), len(way_m) - 1)
    below = np.searchsorted(way_m, way_m[np.maximum(above - 1, 0)])  # the first that is as far
    above, below = np.maximum(above, first + 1), np.maximum(below, first + 1)
    off_m = np.abs(np.stack([way_m[below], way_m[above]]) - target_m)
    second = np.where(off_m[0] <= off_m[1], below, above)
    is_pair = off_m.min(axis=0, initial=np.inf) <= _OFF * distance_m
    return Pairs(first[is_pair], second[is_pair])


def relative_errors(
    T_world_cam: FloatArray, T_truth_cam: FloatArray, pairs: Pairs
) -> tuple[FloatArray, FloatArray]:
    """Return (P,) metres and (P,) degrees that the motions of pairs are off.

    Both are (N, 4, 4) poses, each in a frame of its own.
    """
    first, second = pairs
    T_true = se3.inverse(T_truth_cam[first]) @ T_truth_cam[second]
    T_measured = se3.inverse(T_world_cam[first]) @ T_world_cam[second]
    error = se3.inverse(T_true) @ T_measured
    return se3.translation_norm(error), np.rad2deg(se3.rotation_angle(error))


def root_mean_square(values: FloatArray) -> float:
    """Return that of (N,) values, NaN without any."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


class Statistics(NamedTuple):
    """What is told of many errors, in their unit; NaN where there are none."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


def statistics(values: FloatArray) -> Statistics:
    """Return those of (N,) errors."""
    if len(values) == 0:
        return Statistics(*[float("nan")] * len(Statistics._fields))
    return Statistics(
        root_mean_square(values),
        float(values.mean()),
        float(np.median(values)),
        float(values.std()),
        float(values.min()),
        float(values.max()),
    )

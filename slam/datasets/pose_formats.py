# SPDX-License-Identifier: Apache-2.0
"""The ways of writing poses, one a line: TUM, KITTI, EuRoC, planar."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.datasets.true_poses import rigid
from slam.geometry import se3
from slam.types import FloatArray, SlamError

_MIN_NORM = 1e-6


@dataclass(frozen=True)
class PoseFormat:
    """A way of writing poses, one a line.

    Attributes:
        name: for people.
        columns: what a line holds, for people.
        count: how many numbers that is.
        has_time: whether the first of them is the time; else a line belongs to an image.
        ending: of the file's name.
        separator: between two numbers.
        parse: returns the (4, 4) pose of the others; raises SlamError where they are none.
        numbers: returns the others of a (4, 4) pose.
    """

    name: str
    columns: str
    count: int
    has_time: bool
    ending: str
    separator: str
    parse: Callable[[FloatArray], FloatArray]
    numbers: Callable[[FloatArray], FloatArray]


def _of_quaternion(values: FloatArray) -> FloatArray:
    if np.linalg.norm(values[3:7]) < _MIN_NORM:
        raise SlamError("has a quaternion of length zero")
    return se3.from_rotation_translation(se3.from_quaternion(values[3:7]), values[:3])


def to_quaternion(T: FloatArray) -> FloatArray:
    """Return tx ty tz qx qy qz qw of a (4, 4) pose, as TUM has them."""
    return np.concatenate([T[:3, 3], se3.to_quaternion(T[:3, :3])])


def _of_w_first(values: FloatArray) -> FloatArray:
    return _of_quaternion(values[[0, 1, 2, 4, 5, 6, 3]])


def _to_w_first(T: FloatArray) -> FloatArray:
    return to_quaternion(T)[[0, 1, 2, 6, 3, 4, 5]]


def _of_rows(values: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[: len(values) // 4] = values.reshape(-1, 4)
    try:
        return rigid(T, "pose", Path())
    except SlamError:
        raise SlamError("is no rotation and translation") from None


def _to_three_rows(T: FloatArray) -> FloatArray:
    return T[:3].ravel()


def _to_four_rows(T: FloatArray) -> FloatArray:
    return T.ravel()


def _of_planar(values: FloatArray) -> FloatArray:
    x, y, yaw = values
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0, 0, 1]])
    return se3.from_rotation_translation(R, np.array([x, y, 0.0]))


def _to_planar(T: FloatArray) -> FloatArray:
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])


EUROC = PoseFormat(
    "EuRoC", "time in ns, px py pz qw qx qy qz ...", 8, True, ".csv", ",", _of_w_first, _to_w_first
)
FORMATS = (
    PoseFormat(
        "TUM", "time tx ty tz qx qy qz qw", 8, True, ".txt", " ", _of_quaternion, to_quaternion
    ),
    PoseFormat(
        "KITTI", "a (3, 4) matrix by rows", 12, False, ".txt", " ", _of_rows, _to_three_rows
    ),
    PoseFormat(
        "KITTI with times",
        "time and a (3, 4) matrix",
        13,
        True,
        ".txt",
        " ",
        _of_rows,
        _to_three_rows,
    ),
    PoseFormat(
        "matrices", "a (4, 4) matrix by rows", 16, False, ".txt", " ", _of_rows, _to_four_rows
    ),
    PoseFormat(
        "matrices with times",
        "time and a (4, 4) matrix",
        17,
        True,
        ".txt",
        " ",
        _of_rows,
        _to_four_rows,
    ),
    PoseFormat("planar", "time x y yaw", 4, True, ".txt", " ", _of_planar, _to_planar),
)
"""Told apart by their number of columns; EuRoC's by its times in nanoseconds."""

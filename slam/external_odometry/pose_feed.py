# SPDX-License-Identifier: Apache-2.0
"""Poses of another odometry from a file, handed over as they would come with the images."""

import math
from typing import Protocol

from slam.types import FloatArray, Trajectory


class TakesPoses(Protocol):
    """Who corrects the poses of another odometry."""

    @property
    def time_offset_s(self) -> float:
        """How much later the poses' time stamps are than the images'."""

    def add_pose(self, timestamp_s: float, T_odom_cam: FloatArray) -> None:
        """Take the (4, 4) pose at a time."""


class PoseFeed:
    """Hands over one pose after the other, none where there is no other odometry."""

    def __init__(self, taker: TakesPoses, poses: Trajectory | None) -> None:
        self._taker = taker
        self._next, self._last_s = 0, -math.inf
        self._T_odom_cam = poses.T_world_cam if poses else ()
        self._stamps_s = poses.timestamps_s.tolist() if poses else []

    def until(self, timestamp_s: float) -> None:
        """Hand over all poses until a time of the images', and one more, to be between two."""
        limit_s = timestamp_s + self._taker.time_offset_s
        while self._next < len(self._stamps_s) and self._last_s <= limit_s:
            self._last_s = self._stamps_s[self._next]
            self._taker.add_pose(self._last_s, self._T_odom_cam[self._next])
            self._next += 1

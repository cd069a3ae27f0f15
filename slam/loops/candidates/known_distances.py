# SPDX-License-Identifier: Apache-2.0
"""How far the camera was from where it was before, as far as odometry knows."""

import numpy as np

from placerec.datasets.pose_distance import SAME_PLACE
from slam.geometry import se3
from slam.types import FloatArray, Keyframe

_KNOWN_PATH = 5.0 * SAME_PLACE
"""Odometry has hardly drifted between keyframes with so much of its path between them."""


class KnownDistances:
    """The keyframes so far, and the way between them."""

    def __init__(self) -> None:
        self._earlier = 0  # keyframes of another time, which odometry knows no way from
        self._keyframes: list[Keyframe] = []
        self._path: list[float] = []  # metres plus radians until each keyframe

    def skip(self, count: int) -> None:
        """Let so many keyframes, of an earlier map, come before the first."""
        self._earlier = count

    def add(self, keyframe: Keyframe) -> FloatArray:
        """Remember a keyframe and return (K,) how far it is from each of the K before it.

        It is a share of the distance within which views are of one place (eq. 10), NaN where
        odometry does not know it.
        """
        distances = np.full(self._earlier + len(self._keyframes), np.nan)
        path = 0.0
        if self._keyframes:
            path = self._path[-1] + _distance(self._keyframes[-1], keyframe)
        for k in reversed(range(len(self._keyframes))):
            before = self._keyframes[k]
            if before.segment != keyframe.segment or path - self._path[k] > _KNOWN_PATH:
                break
            distances[self._earlier + k] = _distance(before, keyframe) / SAME_PLACE
        self._keyframes.append(keyframe)
        self._path.append(path)
        return distances


def _distance(a: Keyframe, b: Keyframe) -> float:
    return se3.pose_distance(a.T_odom_cam, b.T_odom_cam)

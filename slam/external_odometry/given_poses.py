# SPDX-License-Identifier: Apache-2.0
"""The poses of an odometry from elsewhere, as they come."""

from bisect import bisect_left

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray, Trajectory

# Between two poses no further apart than so many usual steps, within these bounds, the camera is
# taken to have moved steadily; beyond, where it was is not known.
_USUAL_STEPS, _LEAST_GAP_S, _LARGEST_GAP_S = 3.0, 0.05, 0.5
_SAME_TIME_S = 1e-3


class GivenPoses:
    """Poses in the order of time, with an image or without."""

    def __init__(self) -> None:
        self._stamps_s: list[float] = []
        self._poses: list[FloatArray] = []
        self._covariances: list[FloatArray | None] = []

    def __len__(self) -> int:
        return len(self._stamps_s)

    @property
    def last_s(self) -> float:
        """Time of the last one, minus infinity before there is one."""
        return self._stamps_s[-1] if self._stamps_s else -np.inf

    def add(self, timestamp_s: float, T: FloatArray, covariance: FloatArray | None = None) -> None:
        """Take a (4, 4) pose, and the (6, 6) covariance of the motion since the one before."""
        self._stamps_s.append(timestamp_s)
        self._poses.append(T)
        self._covariances.append(covariance)

    @property
    def trajectory(self) -> Trajectory:
        """All of them, as they were given."""
        return Trajectory(np.array(self._stamps_s), np.array(self._poses).reshape(-1, 4, 4))

    def around(self, timestamp_s: float) -> Trajectory:
        """Return the two of them that a time is between, or the two that are nearest to it.

        Poses come earlier than the images of their time: many may have come that are later.
        """
        first = max(min(bisect_left(self._stamps_s, timestamp_s) - 1, len(self) - 2), 0)
        poses = np.array(self._poses[first : first + 2]).reshape(-1, 4, 4)
        return Trajectory(np.array(self._stamps_s[first : first + 2]), poses)

    def is_at(self, timestamp_s: float) -> bool:
        """Whether there is one of that time, to a millisecond."""
        around_s = self.around(timestamp_s).timestamps_s.tolist()
        nearest = (abs(each - timestamp_s) for each in around_s)
        return min(nearest, default=np.inf) < _SAME_TIME_S

    def covariance(self, start_s: float, end_s: float) -> FloatArray | None:
        """Return the (6, 6) covariance of the motion between two times, None where not all is told.

        Those of its parts are added up, which is what they come to over steps that turn little.
        """
        first, last = np.searchsorted(self._stamps_s, [start_s, end_s], side="right")
        told = [each for each in self._covariances[first:last] if each is not None]
        if not told or len(told) < last - first:
            return None
        return np.asarray(np.sum(told, axis=0))


def poses_between(known: Trajectory, stamps_s: FloatArray) -> FloatArray:
    """Return the (N, 4, 4) poses at (N,) times, NaN where those around are too far apart."""
    found = np.full((len(stamps_s), 4, 4), np.nan)
    if len(known) == 0:
        return found
    times_s, poses = known.timestamps_s, known.T_world_cam
    right = np.searchsorted(times_s, stamps_s)
    is_there = times_s[np.minimum(right, len(times_s) - 1)] == stamps_s
    found[is_there] = poses[right[is_there]]
    if len(known) < 2:
        return found
    usual_s = _USUAL_STEPS * float(np.median(np.diff(times_s)))
    largest_s = np.clip(usual_s, _LEAST_GAP_S, _LARGEST_GAP_S)
    inside = np.flatnonzero(~is_there & (right > 0) & (right < len(times_s)))
    after = right[inside]
    gap_s = times_s[after] - times_s[after - 1]
    inside, after, gap_s = (each[gap_s <= largest_s] for each in (inside, after, gap_s))
    share = (stamps_s[inside] - times_s[after - 1]) / gap_s
    motion = se3.log(se3.inverse(poses[after - 1]) @ poses[after])
    found[inside] = poses[after - 1] @ se3.exp(share[:, None] * motion)
    return found

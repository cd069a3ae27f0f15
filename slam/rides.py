# SPDX-License-Identifier: Apache-2.0
"""Which frame rides on which keyframe: it is corrected when the keyframe is."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from slam.types import FloatArray, Trajectory


@dataclass(frozen=True)
class _Ride:
    timestamp_s: float
    keyframe_id: int
    T_kf_cam: FloatArray


class Rides:
    """Every frame of a run: placed against a keyframe, or lost."""

    def __init__(self) -> None:
        self._rides: list[_Ride] = []
        self._lost_s: list[float] = []

    def add(self, timestamp_s: float, keyframe_id: int, T_kf_cam: FloatArray) -> None:
        """Remember a frame by its (4, 4) place in a keyframe's camera frame."""
        self._rides.append(_Ride(timestamp_s, keyframe_id, T_kf_cam))

    def lose(self, timestamp_s: float) -> None:
        """Remember a frame that could not be placed."""
        self._lost_s.append(timestamp_s)

    def per_keyframe(self) -> Counter[int]:
        """Return how many frames ride on each keyframe id."""
        return Counter(ride.keyframe_id for ride in self._rides)

    def trajectory(self, T_any_kf: FloatArray) -> Trajectory:
        """Return the frames whose keyframe is among (K, 4, 4) poses and not NaN there."""
        rides = [
            ride for ride in self._on(T_any_kf) if np.isfinite(T_any_kf[ride.keyframe_id, 0, 0])
        ]
        return Trajectory(
            timestamps_s=np.array([ride.timestamp_s for ride in rides]),
            T_world_cam=np.array([T_any_kf[ride.keyframe_id] @ ride.T_kf_cam for ride in rides]),
        )

    def unjoined_s(self, T_any_kf: FloatArray) -> FloatArray:
        """Return when the frames were taken whose keyframe is NaN among (K, 4, 4) poses."""
        rides = [ride for ride in self._on(T_any_kf) if np.isnan(T_any_kf[ride.keyframe_id, 0, 0])]
        return np.array([ride.timestamp_s for ride in rides])

    def untracked_s(self, T_any_kf: FloatArray) -> FloatArray:
        """Return when all frames were taken that have no place, in the order of time.

        Those of keyframes that (K, 4, 4) poses leave out are among them.
        """
        left_out_s = [ride.timestamp_s for ride in self._rides if ride.keyframe_id >= len(T_any_kf)]
        return np.sort(np.concatenate([self._lost_s, self.unjoined_s(T_any_kf), left_out_s]))

    def warnings(self, T_any_kf: FloatArray) -> tuple[str, ...]:
        """Return a sentence about the frames that were lost, and one about those not joined."""
        total, warnings = len(self._lost_s) + len(self._rides), []
        if self._lost_s:
            warnings.append(
                f"{len(self._lost_s)} of {total} frames could not be tracked and are in no"
                f" trajectory; the first at {self._lost_s[0]:.3f} s"
            )
        unjoined_s = self.unjoined_s(T_any_kf)
        if len(unjoined_s):
            warnings.append(
                f"{len(unjoined_s)} of {total} frames, from {unjoined_s[0]:.3f} s to"
                f" {unjoined_s[-1]:.3f} s, were tracked apart from the rest and are in no"
                f" trajectory: too few loops agree where they belong{self._beginning(T_any_kf)}"
            )
        return tuple(warnings)

    def _beginning(self, T_any_kf: FloatArray) -> str:
        start_s = self.trajectory(T_any_kf).timestamps_s[0]
        if start_s == self._rides[0].timestamp_s:
            return ""
        return f"; the map is the part with the most frames, which begins at {start_s:.3f} s"

    def _on(self, T_any_kf: FloatArray) -> list[_Ride]:
        return [ride for ride in self._rides if ride.keyframe_id < len(T_any_kf)]

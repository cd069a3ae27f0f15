# SPDX-License-Identifier: Apache-2.0
"""What is known during a run of where the camera really is, one snapshot after the other."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray


@dataclass(frozen=True)
class Correction:
    """What loops made of the keyframes at some moment of a run; it never changes.

    Attributes:
        version: how many corrections came before it.
        newest_id: the newest keyframe that it knows of, -1 for none.
        T_world_kf: (4, 4) by keyframe id; those are missing that are not joined to the largest part
            of the map.
        T_world_odom: (4, 4) by segment, what corrects the odometry where it is now.
        T_world_given: (4, 4), what corrects an odometry from elsewhere; None where there is none,
            or the images contradict it, and then tracking is followed.
        T_world_start: (4, 4), where the graph's first keyframe is, which others count from.
    """

    version: int
    newest_id: int
    T_world_kf: Mapping[int, FloatArray]
    T_world_odom: Mapping[int, FloatArray]
    T_world_given: FloatArray | None = None
    T_world_start: FloatArray = field(default_factory=lambda: np.eye(4))

    def after(self, before: "Correction", T_given_kf: Mapping[int, FloatArray]) -> "Correction":
        """Return it in the world of the one before, by where a given odometry has keyframes.

        Where tracking is followed from now on instead of that odometry, or the other way round, or
        poses count from another keyframe, what both make of the keyframes so far is brought to lie
        on each other: as poses that came out stay, the camera is to leap as little as possible.
        """
        T_world_start = before.T_world_start
        is_turned = (self.T_world_given is None) != (before.T_world_given is None)
        first, first_before = (next(iter(each.T_world_kf), None) for each in (self, before))
        if is_turned or (first_before is not None and first != first_before):
            T_start_kf, T_world_kf = self._placed(T_given_kf), before._placed(T_given_kf)
            common = sorted(T_start_kf.keys() & T_world_kf.keys())
            if common:
                T_world_start = se3.mean_motion(
                    np.array([T_start_kf[k] for k in common]),
                    np.array([T_world_kf[k] for k in common]),
                )
        T_world_given = self.T_world_given
        T_world_kf = T_world_start @ np.array(list(self.T_world_kf.values())).reshape(-1, 4, 4)
        return replace(
            self,
            T_world_kf=dict(zip(self.T_world_kf, T_world_kf, strict=True)),
            T_world_odom={k: T_world_start @ T for k, T in self.T_world_odom.items()},
            T_world_given=None if T_world_given is None else T_world_start @ T_world_given,
            T_world_start=T_world_start,
        )

    def _placed(self, T_given_kf: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
        """Return where keyframes are: by the graph, those that it did not know by what is given."""
        if self.T_world_given is None:
            return dict(self.T_world_kf)
        # Before a leap or a new beginning of that odometry it is corrected by something else.
        return {**{k: self.T_world_given @ T for k, T in T_given_kf.items()}, **self.T_world_kf}

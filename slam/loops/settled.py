# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of a long run stay where they are when new loops correct it on the way."""

from collections.abc import Mapping

from slam.external_odometry.trust import Trust, Verdict
from slam.pose_graph import PoseGraph
from slam.types import FloatArray

# A large graph is solved as a whole whenever it is by so much larger: all that together costs three
# times what the last one does. In between, what is new is laid to what was there.
_WHOLE_GROWTH = 1.5


class Settled:
    """Remembers where the last solution of the whole graph has its keyframes."""

    def __init__(self) -> None:
        self._T_world_kf: Mapping[int, FloatArray] = {}
        self._verdict: Verdict | None = None
        self._is_due = True

    def of(self, graph: PoseGraph) -> Mapping[int, FloatArray]:
        """Return (4, 4) poses by id of keyframes that stay, none where all is to be solved."""
        is_same_world = next(iter(graph.T_world_kf)) == next(iter(self._T_world_kf), None)
        has_grown = len(graph.T_world_kf) > _WHOLE_GROWTH * len(self._T_world_kf)
        self._is_due = self._is_due or not graph.is_large or not is_same_world or has_grown
        return {} if self._is_due else self._T_world_kf

    def take(self, T_world_kf: Mapping[int, FloatArray], trust: Trust | None) -> None:
        """Take a solution, and what is thought by now of an odometry from elsewhere.

        Where that has changed, what was settled was settled on something else.
        """
        verdict = trust.verdict if trust else None
        if self._is_due:
            self._T_world_kf, self._verdict = T_world_kf, verdict
        self._is_due = verdict != self._verdict

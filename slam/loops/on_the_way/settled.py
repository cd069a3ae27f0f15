# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of a long run stay where they are when new loops correct it on the way."""

from collections.abc import Collection, Mapping

from slam.external_odometry.trust import Verdict
from slam.loops.atlas import LargestSubmap
from slam.pose_graph import GraphSolution, PoseGraph
from slam.types import MIN_TRUSTED_WEIGHT, FloatArray

# A large graph is solved as a whole whenever it is by so much larger: all that together costs three
# times what the last one does. In between, what is new is laid to what was there.
_WHOLE_GROWTH = 1.5


class Settled:
    """Remembers where the last solution of the whole graph has its keyframes."""

    def __init__(self) -> None:
        self._T_world_kf: Mapping[int, FloatArray] = {}
        self._verdict: Verdict | None = None
        self._known: Collection[int] = ()  # keys of the loops that the last correction had

    def of(self, graph: PoseGraph) -> Mapping[int, FloatArray]:
        """Return (4, 4) poses by id of keyframes that stay, none where all is to be solved."""
        is_same_world = next(iter(graph.T_world_kf)) == next(iter(self._T_world_kf), None)
        has_grown = len(graph.T_world_kf) > _WHOLE_GROWTH * len(self._T_world_kf)
        return self._T_world_kf if graph.is_large and is_same_world and not has_grown else {}

    def is_contradicted(self, submap: LargestSubmap, solution: GraphSolution) -> bool:
        """Return whether what is laid to it speaks against it, so that all is to be solved.

        Most of the new loops are left out then: what is new is too short to take up all that the
        whole drifted, or was laid to a mistake. Or an odometry from elsewhere is seen otherwise:
        all was settled with its steps, or without them.
        """
        new = [weight for key, weight in solution.weights.items() if key not in self._known]
        left_out = sum(weight <= MIN_TRUSTED_WEIGHT for weight in new)
        return 2 * left_out > len(new) or _verdict(submap) != self._verdict

    def take(self, submap: LargestSubmap, solution: GraphSolution, is_whole: bool) -> None:
        """Take a solution, of the whole graph or of what is new."""
        self._known = frozenset(submap.graph.loops)
        if is_whole:
            self._T_world_kf, self._verdict = solution.T_world_kf, _verdict(submap)


def _verdict(submap: LargestSubmap) -> Verdict | None:
    return submap.trust.verdict if submap.trust else None

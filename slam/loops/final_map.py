# SPDX-License-Identifier: Apache-2.0
"""The map, adjusted in the end to what its loops say."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from slam.loops.back_end import ClosedLoops
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.map_adjustment import adjust_with_loops
from slam.types import FloatArray


@dataclass(frozen=True)
class FinalMap:
    """Where keyframes are in the end.

    Attributes:
        T_world_kf: (K, 4, 4), NaN where the loops' solution has none.
        T_world_kf_without: (K, 4, 4), the same without loops.
        the_map: the adjusted map by `T_world_kf`, None where the pose graph had the last word.
        warnings: why it had, one sentence at most.
    """

    T_world_kf: FloatArray
    T_world_kf_without: FloatArray
    the_map: LandmarkMap | None = None
    warnings: tuple[str, ...] = ()


def left_as_solved(loops: ClosedLoops, why: tuple[str, ...] = ()) -> FinalMap:
    """Return keyframes as the pose graph has them, with a sentence that says why if need be."""
    return FinalMap(loops.T_world_kf, loops.T_world_kf_without, warnings=why)


def adjusted(the_map: LandmarkMap, loops: ClosedLoops) -> FinalMap:
    """Return what the map, which stays as it is, makes of the loops' solution, and of the odometry.

    The latter is adjusted in the same way but for loops; the two do not wait for each other.
    """
    pairs = [(each.match_id, each.query_id) for each in loops.attempts if each.rejection is None]
    placed = np.flatnonzero(np.isfinite(loops.T_world_kf[:, 0, 0])).tolist()

    def adjusted_from(
        T_start_kf: FloatArray, pairs: list[tuple[int, int]]
    ) -> tuple[FloatArray, LandmarkMap]:
        T_world_kf = T_start_kf.copy()
        final = adjust_with_loops(the_map, placed, T_start_kf[placed], pairs, loops.steps)
        T_world_kf[placed] = [final.keyframes[k].T_map_cam for k in placed]
        return T_world_kf, final

    with ThreadPoolExecutor(1, thread_name_prefix="without loops") as beside:
        without = beside.submit(adjusted_from, loops.T_world_kf_without, [])
        T_world_kf, final = adjusted_from(loops.T_world_kf, pairs) if pairs else without.result()
        return FinalMap(T_world_kf, without.result()[0], final)

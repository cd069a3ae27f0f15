# SPDX-License-Identifier: Apache-2.0
"""The map, adjusted in the end to what its loops say."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from slam.loops.back_end import ClosedLoops
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.map_adjustment import adjust_with_loops
from slam.types import FloatArray


def adjusted(
    the_map: LandmarkMap, loops: ClosedLoops
) -> tuple[FloatArray, FloatArray, LandmarkMap]:
    """Return the (K, 4, 4) poses to which the map brings what it begins with, NaN as there.

    That is the loops' solution, and the odometry's, which is adjusted in the same way but for
    loops; the two do not wait for each other. The map itself comes last, by the loops' solution.
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
        return T_world_kf, without.result()[0], final

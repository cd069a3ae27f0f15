# SPDX-License-Identifier: Apache-2.0
"""What each loop did to a solved graph: the same graph without it, to first order.

Without one of its motions the solution of a graph moves by `H^-1 J^T (C - P)^-1 e`, and its sum of
squared errors falls by `e^T (C - P)^-1 e`, with the motion's error e, its covariance C, and
P = J H^-1 J^T what the solution knows of it (Cook and Weisberg 1982, for six numbers at once). One
inverse is enough for all loops.
"""

from collections.abc import Mapping

import numpy as np

from slam.pose_graph.graph import PoseGraph
from slam.pose_graph.motion_system import MotionSystem
from slam.types import MIN_TRUSTED_WEIGHT, FloatArray, Influence


def leave_one_out(
    graph: PoseGraph, T_world_kf: Mapping[int, FloatArray], weights: Mapping[int, float]
) -> dict[int, Influence]:
    """Return by loop key what each loop that has a weight does to the (4, 4) poses that solve it.

    A large graph has none: what every loop does to every keyframe would not fit into memory.
    """
    if not graph.loops or graph.is_large or graph.is_planar:
        return {}
    keyframe_ids = np.array(list(graph.T_world_kf))
    T = np.array([T_world_kf[k] for k in keyframe_ids])
    kept = np.array([weights[key] > MIN_TRUSTED_WEIGHT for key in graph.loops], np.float64)
    keys = list(graph.loops)
    found = {}
    for n, fall, step in MotionSystem(graph).left_out(T, kept):
        moved_m = -np.einsum("kij,kj->ki", T[:, :3, :3], step[:, 3:])
        found[keys[n]] = Influence(keyframe_ids, moved_m.astype(np.float32), fall)
    return found

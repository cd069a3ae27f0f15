# SPDX-License-Identifier: Apache-2.0
"""The robust solution of a large graph, from where it was solved on the way.

GTSAM takes as long for each of its starts as a whole solution takes here. A new keyframe hardly
changes what was found out about the others, so there is one start: the last correction.
"""

import numpy as np

from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.live import graduated, squared_error_limit
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.robust import contested, doubts
from slam.types import FloatArray

_MOST_STEPS = 20
_AT_REST = 1e-8  # of a step: rad and m
_MOST_SOFT_STEPS, _SOFT_AT_REST = 20, 1e-4  # an opinion needs no more than that


def solve_large(graph: PoseGraph, inlier_probability: float) -> GraphSolution:
    """Weigh all loops, of which or of steps there are some, and say what there is to doubt."""
    system = MotionSystem(graph)
    limit = squared_error_limit(inlier_probability)
    T, squared = graduated(system, limit)
    for _ in range(_MOST_STEPS):
        kept = squared < limit
        T, size = system.step(T, kept.astype(np.float64))
        squared = system.squared_errors(T)
        if size < _AT_REST and ((squared < limit) == kept).all():
            break
    is_doubted = contested(kept, squared / limit, _softened(system, T, limit) / limit)
    return GraphSolution(
        dict(zip(graph.T_world_kf, T, strict=True)),
        dict(zip(graph.loops, kept.astype(np.float64).tolist(), strict=True)),
        doubts(kept, is_doubted) if graph.loops else (),
    )


def _softened(system: MotionSystem, T_world_kf: FloatArray, limit: float) -> FloatArray:
    """Return the (L,) squared errors where a Cauchy kernel, which ignores no loop, leads."""
    squared = system.squared_errors(T_world_kf)
    for _ in range(_MOST_SOFT_STEPS):
        T_world_kf, size = system.step(T_world_kf, 1.0 / (1.0 + squared / limit))
        squared = system.squared_errors(T_world_kf)
        if size < _SOFT_AT_REST:
            break
    return squared

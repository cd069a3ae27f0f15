# SPDX-License-Identifier: Apache-2.0
"""The robust solution of a large graph, from where it was solved on the way.

GTSAM takes as long for each of its starts as a whole solution takes here. A new keyframe hardly
changes what was found out about the others, so there is one start: the last correction.
"""

import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.live import graduated, squared_error_limit
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.second_opinion import contested, doubts_of_bridges, second_opinion
from slam.types import FloatArray

_MOST_STEPS = 20
_AT_REST = 1e-8  # of a step: rad and m
_MOST_SOFT_STEPS, _SOFT_AT_REST = 20, 1e-4  # an opinion needs no more than that


def solve_large(graph: PoseGraph, inlier_probability: float) -> GraphSolution:
    """Weigh all loops, of which or of steps there are some, and say what there is to doubt."""
    system = MotionSystem(graph)
    limit = squared_error_limit(inlier_probability, graph.is_planar)
    T, squared = graduated(system, limit)
    T, kept, squared = _at_rest(system, T, squared < limit, limit)
    doubts: tuple[str, ...] = ()
    if graph.loops and system.is_solved and _is_undisputed(system, T, kept, squared, limit):
        doubts = doubts_of_bridges(graph, system, inlier_probability, kept, squared)
    elif graph.loops:
        cost = system.links_cost(T) + float(np.minimum(squared, limit).sum())
        opinion = second_opinion(graph, system, inlier_probability, kept, squared, cost)
        doubts = opinion.doubts
        if opinion.T_world_kf is not None:
            T, kept, squared = _at_rest(system, opinion.T_world_kf, opinion.kept, limit)
    return GraphSolution(
        dict(zip(graph.T_world_kf, T, strict=True)),
        dict(zip(graph.loops, kept.astype(np.float64).tolist(), strict=True)),
        doubts,
        dict(zip(graph.loops, squared.tolist(), strict=True)),
        limit,
    )


def _is_undisputed(
    system: MotionSystem,
    T_world_kf: FloatArray,
    kept: NDArray[np.bool_],
    squared: FloatArray,
    limit: float,
) -> bool:
    """Return whether a Cauchy kernel, which ignores no loop, sees all loops alike.

    To foretell the loops of hours, one after the other, takes minutes. Where false ones that agree
    had won, this kernel was pulled elsewhere, though it cannot tell who is right.
    """
    softened = squared
    for _ in range(_MOST_SOFT_STEPS):
        T_world_kf, size = system.step(T_world_kf, 1.0 / (1.0 + softened / limit))
        softened = system.squared_errors(T_world_kf)
        if size < _SOFT_AT_REST:
            break
    return not contested(kept, squared / limit, softened / limit).any()


def _at_rest(
    system: MotionSystem, T_world_kf: FloatArray, kept: NDArray[np.bool_], limit: float
) -> tuple[FloatArray, NDArray[np.bool_], FloatArray]:
    """Return the poses once exactly the loops within the limit are believed, these and errors."""
    squared = system.squared_errors(T_world_kf)
    for _ in range(_MOST_STEPS):
        T_world_kf, size = system.step(T_world_kf, kept.astype(np.float64))
        squared = system.squared_errors(T_world_kf)
        if size < _AT_REST and ((squared < limit) == kept).all():
            break
        kept = squared < limit
    return T_world_kf, kept, squared

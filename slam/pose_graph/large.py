# SPDX-License-Identifier: Apache-2.0
"""The robust solution of a large graph, from where it was solved on the way.

GTSAM takes as long for each of its starts as a whole solution takes here. A new keyframe hardly
changes what was found out about the others, so there is one start: the last correction.
"""

import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.live import ROUGH, graduated, squared_error_limit
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.second_opinion.opinion import (
    contested,
    doubts,
    doubts_of_bridges,
    second_opinion,
)
from slam.types import FloatArray

_MOST_STEPS = 20
_AT_REST = 1e-6  # of a step: rad and m; in a map of hours none is exact to a tenth of that
_MOST_SOFT_STEPS, _SOFT_AT_REST = 20, 1e-4  # an opinion needs no more than that
# One in ten thousand loops may be in to one estimator and out to the other: it bends next to
# nothing.
_MAY_DIFFER = 1e-4


def solve_large(graph: PoseGraph, inlier_probability: float) -> GraphSolution:
    """Weigh all loops, of which or of steps there are some, and say what there is to doubt."""
    system = MotionSystem(graph)
    limit = squared_error_limit(inlier_probability, graph.is_planar)
    T, squared = graduated(system, limit)
    T, kept, squared = _at_rest(system, T, squared < limit, limit)
    said: tuple[str, ...] = ()
    differing = _differing(system, T, kept, squared, limit) if graph.loops else None
    if differing is not None:
        bridges = doubts_of_bridges(graph, system, inlier_probability, kept, squared)
        said = (*doubts(kept, differing), *bridges)
    elif graph.loops:
        cost = system.links_cost(T) + float(np.minimum(squared, limit).sum())
        opinion = second_opinion(graph, system, inlier_probability, kept, squared, cost)
        said = opinion.doubts
        if opinion.T_world_kf is not None:
            T, kept, squared = _at_rest(system, opinion.T_world_kf, opinion.kept, limit)
    return GraphSolution(
        dict(zip(graph.T_world_kf, T, strict=True)),
        dict(zip(graph.loops, kept.astype(np.float64).tolist(), strict=True)),
        said,
        dict(zip(graph.loops, squared.tolist(), strict=True)),
        limit,
    )


def _differing(
    system: MotionSystem,
    T_world_kf: FloatArray,
    kept: NDArray[np.bool_],
    squared: FloatArray,
    limit: float,
) -> NDArray[np.bool_] | None:
    """Return (L,) the few loops that a Cauchy kernel, which ignores none, clearly sees otherwise.

    To foretell the loops of hours, one after the other, takes minutes. Where false ones that agree
    had won, this kernel was pulled elsewhere, though it cannot tell who is right: None then, and
    where nothing was solved before, to be asked again.
    """
    if not system.is_solved:
        return None
    softened = squared
    for _ in range(_MOST_SOFT_STEPS):
        weights = 1.0 / (1.0 + softened / limit)
        T_world_kf, size = system.step(T_world_kf, weights, ROUGH)
        softened = system.squared_errors(T_world_kf)
        if size < _SOFT_AT_REST:
            break
    differing = contested(kept, squared / limit, softened / limit)
    is_in_dispute = np.count_nonzero(differing) > _MAY_DIFFER * len(differing)
    return None if is_in_dispute else differing


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

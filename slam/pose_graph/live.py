# SPDX-License-Identifier: Apache-2.0
"""The same graph solved beside a camera that is being tracked.

GTSAM keeps Python's global lock for as long as it optimises, and no other thread can track a frame
meanwhile. So the corrections on the way are found here: graduated non-convexity with the cost that
`solve` minimises, by Gauss-Newton steps on arrays. `solve` has the last word.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from scipy.special import gammaincinv

from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.unsettled_part import unsettled_part
from slam.types import FloatArray

_CONVEXITY_STEP = 1.4  # by how much the cost comes nearer to the true one in a round
# From an earlier solution there is no hurry to be feared until loops begin to be given up.
_HURRIED_STEP, _UNDECIDED = 4.0, 0.1
# While the cost is convex, weights are small without a loop being out. In the end it is as sharp as
# it has to be: only loops within a tenth of the limit are neither in nor out, if there are many.
_CONVEX, _SHARP = 0.01, 10.0
_MOST_ROUNDS = 60
_POLISH_STEPS = 3  # once it is clear which loops hold

ROUGH = 1e-3
"""The share of a step that may be left to the next one where that has other weights anyway."""


def solve_beside(
    graph: PoseGraph,
    inlier_probability: float,
    settled: Mapping[int, FloatArray] = MappingProxyType({}),
) -> GraphSolution:
    """Return about what `solve` would, without its warnings, and let other threads run.

    Settled keyframes stay at their (4, 4) poses, by id: what is new is laid to them, and loops
    between two of them are not weighed again.
    """
    if not graph.loops and not graph.steps:
        return GraphSolution(dict(graph.T_world_kf), {})
    settled = {k: settled[k] for k in graph.T_world_kf if k in settled}
    if settled:
        rest = solve_beside(unsettled_part(graph, settled), inlier_probability)
        T_world_kf = {**rest.T_world_kf, **settled}
        return GraphSolution({k: T_world_kf[k] for k in graph.T_world_kf}, rest.weights)
    system = MotionSystem(graph)
    limit = squared_error_limit(inlier_probability, graph.is_planar)
    T, squared = graduated(system, limit)
    for _ in range(_POLISH_STEPS):
        T, _ = system.step(T, np.where(squared < limit, 1.0, 0.0))
        squared = system.squared_errors(T)
    return GraphSolution(
        dict(zip(graph.T_world_kf, T, strict=True)),
        dict(zip(graph.loops, np.where(squared < limit, 1.0, 0.0).tolist(), strict=True)),
    )


def squared_error_limit(inlier_probability: float, is_planar: bool = False) -> float:
    """Return the quantile of chi-square with six degrees of freedom, in the plane with three."""
    half = 1.5 if is_planar else 3.0
    return 2.0 * float(gammaincinv(half, inlier_probability))  # scipy.stats takes long to load


def graduated(system: MotionSystem, limit: float) -> tuple[FloatArray, FloatArray]:
    """Return (K, 4, 4) poses that most loops agree with, and the (L,) squared errors of all.

    A loop has no say beyond the limit of its squared error. The cost is convex at first; then step
    by step what it should be (Yang et al. 2020, truncated least squares).
    """
    T = system.T_start
    squared = system.squared_errors(T)
    convexity = 1.0 / max(2.0 * float(squared.max(initial=0.0)) / limit - 1.0, 1e-6)
    for _ in range(_MOST_ROUNDS):
        weights = _weights(squared, limit, convexity)
        T, _ = system.step(T, weights, ROUGH)
        squared = system.squared_errors(T)
        is_clear = ((weights < 1e-3) | (weights > 1.0 - 1e-3)).all()
        if convexity > (_CONVEX if is_clear else _SHARP):
            break
        hurries = system.is_solved and convexity < _UNDECIDED
        convexity *= _HURRIED_STEP if hurries else _CONVEXITY_STEP
    return T, squared


def _weights(squared: FloatArray, limit: float, convexity: float) -> FloatArray:
    """Return (L,) weights of loops, 0 to 1, by their squared errors: eq. 14 of the paper."""
    between = np.sqrt(limit * convexity * (convexity + 1.0) / np.maximum(squared, 1e-12))
    return np.clip(between - convexity, 0.0, 1.0)

# SPDX-License-Identifier: Apache-2.0
"""The robust solution of a pose graph, which has the last word on every loop."""

import gtsam
import numpy as np

from slam.pose_graph.batch import optimize
from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.large import solve_large
from slam.pose_graph.robust import LINEAR, SUPER_LINEAR, contested_motions, doubts, solve_robustly
from slam.types import MIN_TRUSTED_WEIGHT, FloatArray, Link

_ANCHOR_NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
# The linear schedule is for small maps; with 10,000 loops the other alone takes minutes. Above so
# many loops it is left out.
_MOST_FOR_LINEAR = 3000


def solve(graph: PoseGraph, inlier_probability: float) -> GraphSolution:
    """Weigh all loops against the links and each other, and say what there is to doubt."""
    if not graph.loops and not graph.steps:
        return GraphSolution(dict(graph.T_world_kf), {})
    if graph.is_large:
        return solve_large(graph, inlier_probability)
    initial, believed = _believed(graph)
    if not graph.loops:
        return GraphSolution(_poses(optimize(believed, initial), graph), {})
    everything, loops = believed.clone(), [_factor(loop) for loop in graph.loops.values()]
    for loop in loops:
        everything.add(loop)
    doubted = list(range(believed.size(), everything.size()))
    schedules = (SUPER_LINEAR,) if len(loops) > _MOST_FOR_LINEAR else (SUPER_LINEAR, LINEAR)
    solution = solve_robustly(everything, initial, doubted, inlier_probability, schedules)
    weights = solution.weights[doubted]
    contested = contested_motions(everything, initial, doubted, solution)
    for loop, weight in zip(loops, weights, strict=True):
        if weight > MIN_TRUSTED_WEIGHT:
            believed.add(loop)
    values = optimize(believed, solution.values)
    return GraphSolution(
        _poses(values, graph),
        dict(zip(graph.loops, weights.tolist(), strict=True)),
        doubts(weights > MIN_TRUSTED_WEIGHT, contested),
    )


def _poses(values: gtsam.Values, graph: PoseGraph) -> dict[int, FloatArray]:
    return {k: np.asarray(values.atPose3(k).matrix(), np.float64) for k in graph.T_world_kf}


def _believed(graph: PoseGraph) -> tuple[gtsam.Values, gtsam.NonlinearFactorGraph]:
    """Return where the solution begins, and the factors that nobody doubts."""
    initial, factors = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k, T_world_kf in graph.T_world_kf.items():
        if not factors.size():
            factors.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(T_world_kf), _ANCHOR_NOISE))
        initial.insert(k, gtsam.Pose3(T_world_kf))
    for link in (*graph.links, *graph.steps):
        factors.add(_factor(link))
    return initial, factors


def _factor(link: Link) -> gtsam.BetweenFactorPose3:
    noise = gtsam.noiseModel.Gaussian.Information(link.motion.information)
    T_ref_query = gtsam.Pose3(link.motion.T_ref_query)
    return gtsam.BetweenFactorPose3(link.ref_id, link.query_id, T_ref_query, noise)

# SPDX-License-Identifier: Apache-2.0
"""The robust solution of a pose graph, which has the last word on every loop."""

import gtsam
import numpy as np

from slam.pose_graph.batch import factor_errors, optimize
from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.large import solve_large
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.robust import LINEAR, SUPER_LINEAR, solve_robustly
from slam.pose_graph.second_opinion.opinion import second_opinion
from slam.types import MIN_TRUSTED_WEIGHT, FloatArray, Link

_ANCHOR_NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
# The linear schedule is for small maps; with 10,000 loops the other alone takes minutes. Above so
# many loops it is left out.
_MOST_FOR_LINEAR = 3000


def solve(graph: PoseGraph, inlier_probability: float) -> GraphSolution:
    """Weigh all loops against the links and each other, and say what there is to doubt."""
    if not graph.loops and not graph.steps:
        return GraphSolution(dict(graph.T_world_kf), {})
    if graph.is_large or graph.is_planar:
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
    kept = solution.weights[doubted] > MIN_TRUSTED_WEIGHT
    squared, cost = 2.0 * solution.errors[doubted], 2.0 * solution.cost
    system = MotionSystem(graph)
    opinion = second_opinion(graph, system, inlier_probability, kept, squared, cost)
    weights, values = solution.weights[doubted], solution.values
    if opinion.T_world_kf is not None:
        weights, values = opinion.kept.astype(np.float64), gtsam.Values()
        for k, T_world_kf in zip(graph.T_world_kf, opinion.T_world_kf, strict=True):
            values.insert(k, gtsam.Pose3(T_world_kf))
    for loop, is_kept in zip(loops, opinion.kept, strict=True):
        if is_kept:
            believed.add(loop)
    values = optimize(believed, values)
    squared = 2.0 * factor_errors(everything, values)[doubted]
    return GraphSolution(
        _poses(values, graph),
        dict(zip(graph.loops, weights.tolist(), strict=True)),
        opinion.doubts,
        dict(zip(graph.loops, squared.tolist(), strict=True)),
        2.0 * float(solution.limits[doubted[0]]),
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

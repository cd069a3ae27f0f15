# SPDX-License-Identifier: Apache-2.0
"""The graph of keyframes that links, steps and loops connect, and its robust solution."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.pose_graph.batch import optimize
from slam.pose_graph.robust import LINEAR, SUPER_LINEAR, contested_motions, doubts, solve_robustly
from slam.types import MIN_TRUSTED_WEIGHT, FloatArray, Link

_ANCHOR_NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
# The linear schedule is for small maps; with 10,000 loops the other alone takes minutes. Above so
# many loops it is left out.
_MOST_FOR_LINEAR = 3000


@dataclass(frozen=True)
class PoseGraph:
    """Keyframe poses connected by motions: links are believed, loops have to agree with them.

    The links say how well the odometry knows what it made of the keyframes, so they fit the poses
    that the graph begins with: without a loop or a step that is its solution.

    Attributes:
        T_world_kf: (4, 4) by keyframe id, where the odometry has them; the first one stays.
        links: they connect all keyframes.
        loops: by a key that their weight is found by.
        steps: what an odometry from elsewhere measured, believed as the links are.
    """

    T_world_kf: Mapping[int, FloatArray]
    links: Sequence[Link]
    loops: Mapping[int, Link]
    steps: Sequence[Link] = ()


@dataclass(frozen=True)
class GraphSolution:
    """What a solved graph says.

    Attributes:
        T_world_kf: (4, 4) float64 by keyframe id, metres.
        weights: trust per loop key, 0 (ignored) to 1.
        warnings: one sentence each.
    """

    T_world_kf: dict[int, FloatArray]
    weights: dict[int, float]
    warnings: tuple[str, ...] = ()


def solve(graph: PoseGraph, inlier_probability: float) -> GraphSolution:
    """Weigh all loops against the links and each other, and say what there is to doubt."""
    if not graph.loops and not graph.steps:
        return GraphSolution(dict(graph.T_world_kf), {})
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

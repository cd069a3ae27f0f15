# SPDX-License-Identifier: Apache-2.0
"""Which motions of a pose graph, 2-D or 3-D, to believe: graduated non-convexity (GNC).

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception (2020),
with truncated least squares: a doubted factor costs its half chi-square, up to a limit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.pose_graph.batch import factor_errors, optimize
from slam.types import FloatArray

SUPER_LINEAR = gtsam.GncScheduler.SuperLinear
LINEAR = gtsam.GncScheduler.Linear


@dataclass(frozen=True)
class RobustSolution:
    """Poses and the trust in every factor.

    Attributes:
        values: one pose per key.
        weights: (N,) float64, 0 (ignored) to 1, in the order of the graph's factors.
        errors: (N,) float64, half chi-square of every factor at the poses.
        limits: (N,) float64, the half chi-square from which a doubted factor counts as false.
        cost: what was minimised: the sum of the errors, the doubted ones cut at their limit.
    """

    values: gtsam.Values
    weights: FloatArray
    errors: FloatArray
    limits: FloatArray
    cost: float


def solve_robustly(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    doubted: Sequence[int],
    inlier_probability: float,
    schedules: Sequence[gtsam.GncScheduler] = (SUPER_LINEAR, LINEAR),
) -> RobustSolution:
    """Return the poses that satisfy most of the doubted motions, and which of them those are.

    Doubted are positions of factors in the graph: where a chi-square exceeds the quantile of the
    inlier probability, the factor counts as false. All others are believed. The start is one pose
    per key, from odometry; a schedule says how fast to move from the convex problem to the true
    one. No schedule wins everywhere: the linear one loses all loops of a long path that closes
    rarely, the super-linear one hurries past the answer in small dense maps. The truncated cost,
    which both minimise, tells which of them got further.
    """
    runs = [_graduate(graph, initial, doubted, inlier_probability, each) for each in schedules]
    return min(runs, key=lambda run: run.cost)


def _graduate(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    doubted: Sequence[int],
    inlier_probability: float,
    schedule: gtsam.GncScheduler,
) -> RobustSolution:
    # Start from what is believed: a first least-squares fit to everything, false loops included,
    # would bend the map beyond recognition.
    is_doubted = np.isin(np.arange(graph.size()), list(doubted))
    weights = np.where(is_doubted, 0.0, 1.0)
    params = gtsam.GncLMParams()
    params.setScheduler(schedule)
    params.setKnownInliers(np.flatnonzero(weights).tolist())
    optimizer = gtsam.GncLMOptimizer(graph, initial, params)
    optimizer.setInlierCostThresholdsAtProbability(inlier_probability)
    optimizer.setWeights(weights)
    values = optimizer.optimize()
    weights = np.asarray(optimizer.getWeights(), dtype=np.float64)
    errors = factor_errors(graph, values)
    limits = np.asarray(optimizer.getInlierCostThresholds())
    if not weights[is_doubted].any() and (errors <= limits)[is_doubted].all():
        # Where the odometry contradicts nothing, GNC stops at once with the weights it was given.
        weights = np.ones(graph.size())
        values = optimize(graph, values)
        errors = factor_errors(graph, values)
    cost = float(np.where(is_doubted, np.minimum(errors, limits), errors).sum())
    return RobustSolution(values, weights, errors, limits, cost)

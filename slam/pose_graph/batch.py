# SPDX-License-Identifier: Apache-2.0
"""Batch optimisation of a pose graph, 2-D or 3-D, that does not stay in a poor local optimum."""

from typing import Any

import gtsam
import numpy as np

from slam.types import FloatArray


def optimize(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> gtsam.Values:
    """Return the better of the optima reached from `initial` and from a global start.

    Levenberg-Marquardt from a long odometry chain can end in a local optimum. Rotation
    synchronisation finds a start that knows nothing of the chain, at a fraction of the cost.
    The graph has between factors and a prior that fixes the gauge.
    """
    starts = [initial, *_global_start(graph, initial)]
    optima = [gtsam.LevenbergMarquardtOptimizer(graph, start).optimize() for start in starts]
    return min(optima, key=graph.error)


def pose_at(values: gtsam.Values, key: int) -> Any:
    """Return the Pose2 or Pose3 of a key, whichever of the two the graph holds."""
    try:
        return values.atPose3(key)
    except (RuntimeError, ValueError, TypeError):
        return values.atPose2(key)


def _global_start(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> list[gtsam.Values]:
    """Return the start that synchronisation finds, moved to where `initial` begins, or nothing."""
    between = (gtsam.BetweenFactorPose2, gtsam.BetweenFactorPose3)
    factors: list[Any] = [graph.at(i) for i in range(graph.size())]
    factors = [each for each in factors if isinstance(each, between)]
    if not factors:
        return []
    is_planar = isinstance(factors[0], gtsam.BetweenFactorPose2)
    keys = list(initial.keys())
    try:
        found = (gtsam.fastSyncPose2 if is_planar else gtsam.fastSyncPose3)(_isotropic(factors))
        anchor = pose_at(initial, keys[0]).compose(pose_at(found, keys[0]).inverse())
        moved = gtsam.Values()
        for key in keys:
            moved.insert(key, anchor.compose(pose_at(found, key)))
    except RuntimeError:  # it needs a well-connected graph; without one `initial` has to do
        return []
    return [moved]


def _isotropic(factors: list[Any]) -> gtsam.NonlinearFactorGraph:
    """Return the same measurements with unit noise, the only kind synchronisation takes."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        noise = gtsam.noiseModel.Isotropic.Sigma(factor.dim(), 1.0)
        graph.add(type(factor)(*factor.keys(), factor.measured(), noise))
    return graph


def factor_errors(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> FloatArray:
    """Return the (N,) float64 half chi-square of every factor."""
    return np.array([graph.at(i).error(values) for i in range(graph.size())])

# SPDX-License-Identifier: Apache-2.0
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
import pytest

from slam.pose_graph.batch import optimize, pose_at
from slam.pose_graph.robust import (
    LINEAR,
    SUPER_LINEAR,
    solve_robustly,
)
from slam.types import MIN_TRUSTED_WEIGHT

LAP = 20
SIGMAS = np.array([0.02, 0.02, 0.01])


def planar_laps(loops: Sequence[tuple[int, int, gtsam.Pose2]]) -> tuple[Any, Any, list[int]]:
    """Two noisy laps of a circle in the plane and the given loops."""
    rng = np.random.default_rng(3)
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    graph, chain = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise))
    chain.insert(0, gtsam.Pose2())
    for i in range(2 * LAP - 1):
        step = gtsam.Pose2(1.0, 0.0, 2.0 * np.pi / LAP)
        step = step.compose(gtsam.Pose2.Expmap(rng.normal(size=3) * SIGMAS))
        graph.add(gtsam.BetweenFactorPose2(i, i + 1, step, noise))
        chain.insert(i + 1, chain.atPose2(i).compose(step))
    first_loop = graph.size()
    for ref, query, motion in loops:
        graph.add(gtsam.BetweenFactorPose2(ref, query, motion, noise))
    return graph, chain, list(range(first_loop, graph.size()))


TRUE = [(i, i + LAP, gtsam.Pose2()) for i in range(0, LAP, 2)]
FALSE = [(i, i + LAP // 2, gtsam.Pose2(0.1 * i, 0.0, 0.2 * i)) for i in range(LAP)]


@pytest.mark.parametrize("schedules", [(SUPER_LINEAR,), (LINEAR,), (SUPER_LINEAR, LINEAR)])
def test_a_planar_graph_keeps_its_true_loops_only(schedules: tuple[Any, ...]) -> None:
    graph, chain, loops = planar_laps(TRUE + FALSE)
    solution = solve_robustly(graph, chain, loops, 0.99, schedules)
    kept = solution.weights[loops] > MIN_TRUSTED_WEIGHT
    assert kept.tolist() == [True] * len(TRUE) + [False] * len(FALSE)
    assert (np.delete(solution.weights, loops) == 1.0).all()


def test_the_limit_is_the_quantile_of_chi_square() -> None:
    graph, chain, loops = planar_laps(TRUE)
    solution = solve_robustly(graph, chain, loops, 0.99)
    assert solution.limits[loops] == pytest.approx(11.3449 / 2.0, abs=1e-3)  # 3 degrees of freedom
    assert solution.cost == pytest.approx(solution.errors.sum())


def test_the_cheaper_schedule_wins() -> None:
    graph, chain, loops = planar_laps(TRUE + FALSE)
    each = [solve_robustly(graph, chain, loops, 0.99, (one,)) for one in (SUPER_LINEAR, LINEAR)]
    both = solve_robustly(graph, chain, loops, 0.99)
    assert both.cost == min(one.cost for one in each)


def test_optimize_leaves_a_local_optimum() -> None:
    graph, chain, _ = planar_laps(TRUE)
    turned = gtsam.Values()
    for i in range(2 * LAP):  # every other pose points backwards
        turned.insert(i, gtsam.Pose2(0.0, 0.0, np.pi * (i % 2)))
    stuck = gtsam.LevenbergMarquardtOptimizer(graph, turned).optimize()
    best = graph.error(optimize(graph, chain))
    assert graph.error(stuck) > 2.0 * best
    assert graph.error(optimize(graph, turned)) == pytest.approx(best, rel=1e-4)


def test_optimize_keeps_the_anchor() -> None:
    graph, chain, _ = planar_laps(TRUE)
    assert np.abs(pose_at(optimize(graph, chain), 0).translation()).max() < 1e-9

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import se3
from slam.pose_graph import solve_beside
from slam.pose_graph.unsettled_part import unsettled_part

PROBABILITY = 0.9999
OLD = 80  # keyframes: two rounds of three


def settled_by(world, loops):
    """Return where the keyframes of the first two rounds are, solved with their loops."""
    found = solve_beside(world.graph(loops), PROBABILITY).T_world_kf
    return {k: T for k, T in found.items() if k < OLD}


def test_what_is_new_is_laid_to_what_stays(corridors):
    world = corridors()
    old, new = world.true(0, 40), world.true(40, 40)
    settled, graph = settled_by(world, old), world.graph([*old, *new])
    part = solve_beside(graph, PROBABILITY, settled)
    whole = solve_beside(graph, PROBABILITY)
    assert list(part.T_world_kf) == list(graph.T_world_kf)
    assert all((part.T_world_kf[k] == T).all() for k, T in settled.items())
    assert part.weights == dict.fromkeys(range(len(old), len(graph.loops)), 1.0)
    open_m = world.rmse_m(graph.T_world_kf)
    assert world.rmse_m(whole.T_world_kf) < world.rmse_m(part.T_world_kf) < 0.4 * open_m


def test_false_loops_to_what_stays_are_ignored(corridors):
    world = corridors()
    old, new, false = world.true(0, 40), world.true(40, 40), world.alike(5, 110, 5)
    settled = settled_by(world, old)
    without = solve_beside(world.graph([*old, *new]), PROBABILITY, settled)
    found = solve_beside(world.graph([*old, *new, *false]), PROBABILITY, settled)
    assert [key for key, weight in found.weights.items() if weight < 0.5] == [80, 81, 82, 83, 84]
    for k, T in without.T_world_kf.items():
        np.testing.assert_allclose(found.T_world_kf[k], T, atol=1e-3)


def test_without_a_loop_the_rest_goes_on_by_the_odometry_from_what_stays(corridors):
    world = corridors()
    old = world.true(0, 40)
    settled, graph = settled_by(world, old), world.graph(old)
    T = solve_beside(graph, PROBABILITY, settled).T_world_kf
    last = graph.T_world_kf[OLD - 1]
    for k in range(OLD, len(T)):
        by_odometry = settled[OLD - 1] @ se3.inverse(last) @ graph.T_world_kf[k]
        np.testing.assert_allclose(T[k], by_odometry, atol=1e-9)


def test_only_what_the_new_ones_hang_on_is_taken_along(corridors):
    world = corridors()
    graph = world.graph(world.true(30, 15))  # 40 to 44 are seen again by 80 to 84
    settled = {k: T for k, T in graph.T_world_kf.items() if k < OLD}
    part = unsettled_part(graph, settled)
    assert list(part.T_world_kf) == [*range(40, 45), OLD - 1, *range(OLD, 120)]
    assert len(part.loops) == 5
    assert len(part.links) == 5 + 40  # holds, and the odometry from the last that stays


@pytest.mark.parametrize("is_all", [True, False])
def test_what_is_settled_altogether_stays(corridors, is_all):
    world = corridors()
    graph = world.graph(world.true(0))
    settled = dict(graph.T_world_kf) if is_all else {}
    found = solve_beside(graph, PROBABILITY, settled)
    assert bool(found.weights) != is_all and found.T_world_kf.keys() == graph.T_world_kf.keys()

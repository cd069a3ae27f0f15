# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import se3
from slam.pose_graph import PoseGraph, leave_one_out
from slam.pose_graph.motion_system import MotionSystem
from slam.types import Link, RelativePose

COUNT = 30
NOISE = np.array([0.01, 0.01, 0.01, 0.02, 0.02, 0.02])
INFORMATION = np.diag(NOISE**-2)


def graph_of(seed, false=None):
    """Return two rounds of odometry, with loops between them of which one may be false."""
    generator = np.random.default_rng(seed)
    angles = 4 * np.pi * np.arange(COUNT) / COUNT
    T = se3.exp(np.column_stack([np.zeros((COUNT, 2)), angles, np.zeros((COUNT, 3))]))
    T[:, :3, 3] = np.column_stack([2 * np.cos(angles), 2 * np.sin(angles), 0.1 * angles])

    def measured(a, b, wrong=None):
        error = NOISE * generator.standard_normal(6) + (0.0 if wrong is None else wrong)
        return Link(a, b, RelativePose(se3.inverse(T[a]) @ T[b] @ se3.exp(error), INFORMATION))

    links = [measured(k, k + 1) for k in range(COUNT - 1)]
    loops = {k: measured(k, k + COUNT // 2) for k in range(COUNT // 2)}
    if false is not None:
        wrong = np.array([0.0, 0.0, 0.2, *generator.uniform(0.3, 0.6, 3)])
        loops[false] = measured(false, false + COUNT // 2, wrong)
    start = [T[0]]
    for link in links:
        start.append(start[-1] @ link.motion.T_ref_query)
    return PoseGraph(dict(enumerate(start)), links, loops)


def solved(graph):
    """Return the poses with all loops believed, and the sum of their squared errors."""
    system, T = MotionSystem(graph), np.array([*graph.T_world_kf.values()])
    for _ in range(20):
        T, _ = system.step(T, np.ones(len(graph.loops)))
    everything = PoseGraph(
        graph.T_world_kf, graph.links[:1], dict(enumerate([*graph.links, *graph.loops.values()]))
    )
    return dict(enumerate(T)), MotionSystem(everything).squared_errors(T).sum()


def influences(graph):
    return leave_one_out(graph, solved(graph)[0], dict.fromkeys(graph.loops, 1.0))


def test_it_says_what_solving_again_without_a_loop_says():
    graph = graph_of(0)
    (T, cost), found = solved(graph), influences(graph)
    for key in (0, 7):
        left = {k: loop for k, loop in graph.loops.items() if k != key}
        T_without, cost_without = solved(PoseGraph(graph.T_world_kf, graph.links, left))
        moved_m = np.array([T[k][:3, 3] - T_without[k][:3, 3] for k in T])
        assert found[key].chi_square == pytest.approx(cost - cost_without, rel=0.05)
        np.testing.assert_allclose(found[key].moved_m, moved_m, atol=0.05 * np.abs(moved_m).max())
        assert found[key].rms_m == pytest.approx(np.sqrt((moved_m**2).sum(axis=1).mean()), rel=0.05)
        assert found[key].most[0] == np.argmax(np.linalg.norm(moved_m, axis=1))


@pytest.mark.parametrize("seed", range(10))
def test_an_injected_loop_is_the_most_harmful_one_where_none_is_outvoted(seed):
    false = seed + 3
    found = influences(graph_of(seed, false))
    assert max(found, key=lambda key: found[key].chi_square) == false


def test_a_true_loop_costs_what_its_noise_claims():
    found = [each.chi_square for seed in range(20) for each in influences(graph_of(seed)).values()]
    assert np.mean(found) == pytest.approx(6.0, rel=0.15)


def test_a_loop_without_a_say_moves_nothing():
    graph = graph_of(0, false=4)
    weights = {key: float(key != 4) for key in graph.loops}
    assert set(leave_one_out(graph, solved(graph)[0], weights)) == set(graph.loops) - {4}
    assert leave_one_out(PoseGraph(graph.T_world_kf, graph.links, {}), graph.T_world_kf, {}) == {}

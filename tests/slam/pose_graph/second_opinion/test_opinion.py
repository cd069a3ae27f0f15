# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.pose_graph import solve
from slam.pose_graph.second_opinion.opinion import contested, doubts, second_opinion
from slam.types import Link, RelativePose

PROBABILITY = 0.95
SIGMAS = np.array([0.003, 0.003, 0.003, 0.01, 0.01, 0.01])  # of the loops of corridors
BEND = 0.5  # sigmas, of all links alike: over a round that is 2.4 times as far as they claim


def kept(solution):
    return [key for key, weight in solution.weights.items() if weight > 0.5]


@pytest.mark.parametrize("small", [30, 500], ids=["as large", "as small"])
def test_a_cluster_beyond_what_the_odometry_can_be_off_is_left_out_by_name(
    corridors, monkeypatch, small
):
    """It is cheaper to bend the odometry than to leave out ten loops, and GNC takes them."""
    monkeypatch.setattr("slam.pose_graph.graph._SMALL", small)
    world = corridors()
    graph = world.graph(world.alike(30, 72))
    solution = solve(graph, PROBABILITY)
    assert kept(solution) == []
    assert world.rmse_m(solution.T_world_kf) <= world.rmse_m(graph.T_world_kf) + 1e-6
    assert len(solution.warnings) >= 1


def test_what_the_odometry_cannot_decide_is_left_out_and_said(corridors):
    world = corridors(worse=60.0)
    graph = world.graph(world.alike(5, 75))
    solution = solve(graph, PROBABILITY)
    assert kept(solution) == []
    assert world.rmse_m(solution.T_world_kf) == pytest.approx(
        world.rmse_m(dict(graph.T_world_kf)), abs=1e-3
    )
    text = " ".join(solution.warnings)
    assert "10 loops that agree of keyframes 5-14 and 75-84" in text
    assert "the odometry cannot tell whether it is true" in text


def test_where_both_agree_nothing_is_said(corridors):
    world = corridors()
    solution = solve(world.graph(world.true(0) + world.true(45)), PROBABILITY)
    assert len(kept(solution)) >= 18
    assert solution.warnings == ()


def test_a_true_loop_in_the_tail_of_its_noise_is_kept(corridors):
    """It is three and a half sigmas off: GNC leaves out what costs more than a twentieth does."""
    world = corridors()
    motion = world.motion(5, 45) @ se3.exp(np.array([0.0, 0.0, 0.0, 0.035, 0.0, 0.0]))
    tail = Link(5, 45, RelativePose(motion, np.diag(1.0 / SIGMAS**2)))
    solution = solve(world.graph([*world.true(0), *world.true(45), tail]), PROBABILITY)
    assert kept(solution) == list(range(21)) and solution.warnings == ()


def test_true_loops_are_kept_where_several_links_of_a_keyframe_repeat_its_error(corridors):
    """Were they independent, three of them would know each way 1.7 times better than one does."""
    world = corridors(bend=0.35)
    graph = world.graph(world.true(0) + world.true(12))
    solution = solve(replace(graph, links=[each for each in graph.links for _ in range(3)]), 0.95)
    assert len(kept(solution)) >= 18 and solution.warnings == ()


@pytest.mark.parametrize(
    ("is_kept", "first", "second", "is_contested"),
    [
        (True, 0.5, 4.1, True),
        (True, 0.5, 4.0, False),
        (False, 4.1, 0.9, True),
        (False, 4.0, 0.9, False),
        (False, 4.1, 1.0, False),
    ],
)
def test_contested_is_what_one_believes_and_the_other_sees_clearly_out(
    is_kept, first, second, is_contested
):
    """The errors are given as multiples of the limit."""
    found = contested(np.array([is_kept]), np.array([first]), np.array([second]))
    assert found.tolist() == [is_contested]


def test_a_doubt_counts_what_was_kept_of_the_contested():
    (sentence,) = doubts(np.array([True, True, False]), np.array([True, False, True]), ": those")
    assert "2 of 3 loops (2 were kept, 1 of them contested): those; look at them" in sentence
    assert doubts(np.array([True]), np.array([False])) == ()
    (sentence,) = doubts(np.array([False]), np.array([False]))
    assert "all 1 loops" in sentence


def test_a_large_graph_solved_on_the_way_is_only_looked_at_where_there_is_a_doubt(
    corridors, monkeypatch
):
    monkeypatch.setattr("slam.pose_graph.graph._SMALL", 30)
    world, asked = corridors(), []

    def noted(*about):
        asked.append(about)
        return second_opinion(*about)

    monkeypatch.setattr("slam.pose_graph.large.second_opinion", noted)
    sound = world.graph(world.true(0) + world.true(45))
    solution = solve(replace(sound, solved=sound.T_world_kf), PROBABILITY)
    assert len(kept(solution)) >= 18 and not asked and solution.warnings == ()
    bent = world.graph(world.alike(30, 72))
    solution = solve(replace(bent, solved=bent.T_world_kf), PROBABILITY)
    assert kept(solution) == [] and len(asked) == 1
    assert world.rmse_m(solution.T_world_kf) <= world.rmse_m(bent.T_world_kf) + 1e-6


def test_false_loops_over_a_weak_link_are_judged_like_all_others(corridors):
    world = corridors()
    world.set_information(55, world.links[55].motion.information / 11.0**2)
    graph = world.graph(world.alike(30, 72))
    solution = solve(graph, PROBABILITY)
    assert kept(solution) == [] and solution.warnings
    assert world.rmse_m(solution.T_world_kf) <= world.rmse_m(graph.T_world_kf) + 1e-6


@pytest.mark.parametrize("small", [30, 500], ids=["as large", "as small"])
def test_true_loops_all_over_are_kept_though_the_odometry_drifts_further_than_it_says(
    corridors, monkeypatch, small
):
    monkeypatch.setattr("slam.pose_graph.graph._SMALL", small)
    world = corridors(bend=BEND)
    graph = world.graph(world.all_over())
    solution = solve(graph, PROBABILITY)
    assert kept(solution) == list(range(15))
    assert world.rmse_m(solution.T_world_kf) < 0.4 * world.rmse_m(graph.T_world_kf)
    (warning,) = solution.warnings
    assert "the odometry drifts 2.4 times as far as its links claim" in warning


def test_a_false_cluster_beside_them_is_left_out(corridors):
    world = corridors(bend=BEND)
    solution = solve(world.graph(world.all_over() + world.alike(30, 72)), PROBABILITY)
    assert kept(solution) == list(range(15))


@pytest.mark.parametrize("second", [71, 72])
def test_a_false_cluster_alone_cannot_make_the_odometry_out_to_be_worse(corridors, second):
    world = corridors(bend=BEND)
    graph = world.graph(world.alike(30, second))
    solution = solve(graph, PROBABILITY)
    assert kept(solution) == [] and solution.warnings
    assert world.rmse_m(solution.T_world_kf) == pytest.approx(world.rmse_m(graph.T_world_kf))


def test_loops_at_one_place_are_left_out_and_what_they_say_is_said(corridors):
    """Near, and of an odometry that drifts, but so might be those of a place that looks alike."""
    world = corridors(bend=BEND)
    solution = solve(world.graph(world.true(10, 8)), PROBABILITY)
    assert kept(solution) == []
    said = "for 8 loops that agree to be true the odometry would have to drift 2.5 times as far"
    assert any(said in warning for warning in solution.warnings)


def test_where_the_links_can_be_relied_on_nothing_is_made_of_false_loops_all_over(corridors):
    world = corridors()
    false = [*world.alike(5, 46), *world.alike(25, 66)]
    assert kept(solve(world.graph(false), PROBABILITY)) == []
    assert kept(solve(world.graph(world.all_over() + false), PROBABILITY)) == list(range(15))

# SPDX-License-Identifier: Apache-2.0
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from slam.pose_graph.motion_system import MotionSystem
from slam.types import Link, RelativePose

CUT = 55  # between the keyframes 55 and 56


def bridges(world):
    """Return which of loops before, across and behind the cut are bridges."""
    loops = [*world.true(5, 1), *world.true(30, 1), *world.true(60, 1)]
    return MotionSystem(world.graph(loops)).bridges.tolist()


def test_loops_over_what_joins_recordings_are_bridges(corridors):
    world = corridors()
    world.set_information(CUT, np.eye(6))
    assert bridges(world) == [False, True, False]


def test_loops_over_a_weak_link_are_none(corridors):
    """What is eleven times as uncertain as the others still says a lot."""
    world = corridors()
    world.set_information(CUT, world.links[CUT].motion.information / 11.0**2)
    assert bridges(world) == [False] * 3


def test_links_of_other_units_are_not_all_next_to_nothing(corridors):
    world = corridors()
    for k, link in enumerate(world.links):
        world.set_information(k, 1e-6 * link.motion.information)
    assert bridges(world) == [False] * 3


def off(graph):
    """Return how far off the poses may be, as a root mean square of all their numbers."""
    system = MotionSystem(graph)
    return np.sqrt((system.draws(system.T_links) ** 2).mean())


def test_several_links_of_a_keyframe_know_its_way_no_better_than_one(corridors):
    """One image made them all."""
    chain = corridors().graph([])
    tied = replace(chain, links=[link for link in chain.links for _ in range(3)])
    assert off(tied) == pytest.approx(off(chain), rel=0.2)


def test_a_link_against_the_order_of_keyframes_is_that_of_the_later_one(corridors):
    graph = corridors().graph([])
    turned = [against(each) if each.ref_id % 2 else each for each in graph.links]
    assert off(replace(graph, links=turned)) == pytest.approx(off(graph), rel=0.2)


def against(link):
    T_query_ref = np.linalg.inv(link.motion.T_ref_query)
    return Link(link.query_id, link.ref_id, RelativePose(T_query_ref, link.motion.information))


@pytest.fixture
def many_loops(corridors, monkeypatch):
    """Return 2000 loops of 120 poses, of which few are looked at at once."""
    monkeypatch.setattr("slam.pose_graph.motion_system._AT_ONCE", 50)
    monkeypatch.setattr("slam.pose_graph.motion_system._DRAWN_AT_ONCE", 50)
    world = corridors()
    return MotionSystem(world.graph(100 * (world.true(0) + world.true(45))))


def peak_mb(function, *about):
    tracemalloc.start()
    try:
        result = function(*about)
        return result, tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def test_of_many_motions_no_draws_are_kept(many_loops, monkeypatch):
    """Each takes 3 kB; and in slices they are the same."""
    draws, needed_mb = peak_mb(many_loops.draws, many_loops.T_links)
    assert needed_mb < 12.0
    monkeypatch.setattr("slam.pose_graph.motion_system._DRAWN_AT_ONCE", 10_000)
    np.testing.assert_allclose(draws, many_loops.draws(many_loops.T_links), atol=1e-12)


def test_of_many_pairs_no_draws_are_kept(many_loops, monkeypatch):
    T, draws = many_loops.T_links, many_loops.draws(many_loops.T_links)
    pairs = np.random.default_rng(0).integers(many_loops.loop_count, size=(2000, 2))
    squared, needed_mb = peak_mb(many_loops.cycles, T, draws, pairs)
    assert needed_mb < 5.0
    monkeypatch.setattr("slam.pose_graph.motion_system._AT_ONCE", 2000)
    np.testing.assert_array_equal(squared, many_loops.cycles(T, draws, pairs))
    assert many_loops.cycles(T, draws, pairs[:0]).shape == (0,)

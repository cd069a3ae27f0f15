# SPDX-License-Identifier: Apache-2.0
import numpy as np

from slam.pose_graph.live import squared_error_limit
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.second_opinion.clusters import clusters

WIDE = squared_error_limit(0.999)


def numbers(graph, chosen=None):
    system = MotionSystem(graph)
    chosen = np.ones(len(graph.loops), np.bool_) if chosen is None else chosen
    return clusters(system, system.T_links, chosen, WIDE).tolist()


def test_loops_that_agree_are_one_cluster_true_or_not(corridors):
    world = corridors()
    found = numbers(world.graph(world.true(0) + world.alike(50, 90)))
    assert found == [0] * 10 + [1] * 10


def test_loops_of_the_same_places_that_contradict_each_other_are_two(corridors):
    world = corridors()
    found = numbers(world.graph(world.true(0) + world.alike(0, 43)))
    assert len({*found[:10]}) == len({*found[10:]}) == 1
    assert {*found[:10]}.isdisjoint(found[10:])


def test_only_the_chosen_are_numbered(corridors):
    world = corridors()
    chosen = np.arange(20) % 2 == 0
    assert numbers(world.graph(world.true(0) + world.alike(50, 90)), chosen) == [0] * 5 + [1] * 5


def test_one_loop_is_a_cluster(corridors):
    world = corridors()
    assert numbers(world.graph(world.true(0, 1))) == [0]

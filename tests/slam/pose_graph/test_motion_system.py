# SPDX-License-Identifier: Apache-2.0
import numpy as np

from slam.pose_graph.motion_system import MotionSystem

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

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.second_opinion.drift import _are_all_over, drift


def times(loops, world):
    return drift(MotionSystem(world.graph(loops)), np.ones(len(loops), np.bool_))


def test_drift_is_that_of_most_loops(corridors):
    assert times(corridors().all_over(), corridors()) == pytest.approx(1.0, abs=0.3)
    bent = corridors(bend=0.5)
    loops = bent.all_over()
    assert 2.0 < times(loops, bent) < 3.0
    assert times(loops + bent.alike(30, 72, 3), bent) == pytest.approx(times(loops, bent), abs=0.3)


def test_loops_lie_all_over_where_they_spread_as_the_map_does(corridors):
    world = corridors()
    system = MotionSystem(world.graph(world.all_over()))
    at = np.arange(15)
    assert _are_all_over(system, system.T_links, at >= 0)
    assert not _are_all_over(system, system.T_links, at < 5)

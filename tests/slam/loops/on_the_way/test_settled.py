# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.external_odometry.trust import Trust, Verdict
from slam.loops.atlas import LargestSubmap
from slam.loops.on_the_way.settled import Settled
from slam.pose_graph import GraphSolution, PoseGraph


def graph(*ids):
    return PoseGraph({k: np.eye(4) for k in ids}, (), {})


def submap(of, trust=None, loops=()):
    return LargestSubmap(replace(of, loops=dict.fromkeys(loops)), {}, {}, {}, trust, {})


def solution(of, weights=None):
    return GraphSolution(of.T_world_kf, weights or {})


@pytest.fixture(autouse=True)
def _ten_are_large(monkeypatch):
    monkeypatch.setattr("slam.pose_graph.graph._SMALL", 10)


def solved_as_a_whole(graphs):
    """Return whether each graph, one after the other, is solved as a whole."""
    settled, whole = Settled(), []
    for each in graphs:
        whole.append(not settled.of(each))
        settled.take(submap(each), solution(each), whole[-1])
    return whole


def test_a_small_graph_is_always_solved_as_a_whole():
    assert all(solved_as_a_whole(graph(*range(n)) for n in range(1, 11)))


def test_a_large_one_is_whenever_it_is_by_half_larger():
    whole = solved_as_a_whole(graph(*range(n)) for n in range(11, 80))
    assert [n for n, each in enumerate(whole, 11) if each] == [11, 17, 26, 40, 61]


def test_another_world_is_solved_as_a_whole():
    one, other = graph(*range(20)), graph(*range(20, 60))
    assert solved_as_a_whole([one, one, other, other]) == [True, False, True, False]


def test_another_verdict_on_an_odometry_from_elsewhere_contradicts_what_is_settled():
    """What stays was solved with its steps, or without them."""
    believed = Trust(Verdict.BORNE_OUT, np.ones(3), np.ones(3), (), (), 100)
    doubted = replace(believed, verdict=Verdict.CONTRADICTED)
    settled, of = Settled(), graph(*range(20))
    settled.take(submap(of, believed), solution(of), True)
    assert not settled.is_contradicted(submap(of, believed), solution(of))
    assert settled.is_contradicted(submap(of, doubted), solution(of))
    settled.take(submap(of, doubted), solution(of), True)
    assert settled.is_contradicted(submap(of, believed), solution(of))


def test_new_loops_contradict_it_if_most_are_left_out():
    settled, of = Settled(), graph(*range(20))
    settled.take(submap(of, loops=(0, 1)), solution(of), True)
    assert not settled.is_contradicted(submap(of), solution(of, {2: 1.0, 3: 0.0}))
    assert settled.is_contradicted(submap(of), solution(of, {2: 1.0, 3: 0.0, 4: 0.0}))
    settled.take(submap(of, loops=(0, 1, 2, 3, 4)), solution(of), False)
    again = {2: 1.0, 3: 0.0, 4: 0.0}  # which was asked already
    assert not settled.is_contradicted(submap(of), solution(of, again))

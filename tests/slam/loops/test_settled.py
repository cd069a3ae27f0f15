# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.external_odometry.trust import Trust, Verdict
from slam.loops.settled import Settled
from slam.pose_graph import PoseGraph


def graph(*ids):
    return PoseGraph({k: np.eye(4) for k in ids}, (), {})


@pytest.fixture(autouse=True)
def _ten_are_large(monkeypatch):
    monkeypatch.setattr("slam.pose_graph.graph._SMALL", 10)


def solved_as_a_whole(graphs, trust=None):
    """Return whether each graph, one after the other, is solved as a whole."""
    settled, whole = Settled(), []
    for each in graphs:
        whole.append(not settled.of(each))
        settled.take(each.T_world_kf, trust)
    return whole


def test_a_small_graph_is_always_solved_as_a_whole():
    assert all(solved_as_a_whole(graph(*range(n)) for n in range(1, 11)))


def test_a_large_one_is_whenever_it_is_by_half_larger():
    whole = solved_as_a_whole(graph(*range(n)) for n in range(11, 80))
    assert [n for n, each in enumerate(whole, 11) if each] == [11, 17, 26, 40, 61]


def test_another_world_is_solved_as_a_whole():
    one, other = graph(*range(20)), graph(*range(20, 60))
    assert solved_as_a_whole([one, one, other, other]) == [True, False, True, False]


def test_another_verdict_on_an_odometry_from_elsewhere_settles_nothing():
    """What stays was solved with its steps, or without them."""
    believed = Trust(Verdict.BORNE_OUT, np.ones(3), np.ones(3), (), (), 100)
    doubted = replace(believed, verdict=Verdict.CONTRADICTED)
    settled, of = Settled(), graph(*range(20))
    for trust, is_whole in ((believed, True), (believed, False), (doubted, False), (doubted, True)):
        assert (not settled.of(of)) == is_whole
        settled.take(of.T_world_kf, trust)
    assert settled.of(of)

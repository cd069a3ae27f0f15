# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.evaluation.stress.false_loops import CLUSTERS, SCATTERED, Places, false_loops
from slam.geometry import se3
from slam.types import LoopAttempt, RelativePose, Verification

COUNT, MIN_GAP, MIN_ERROR_M = 60, 5, 0.1
INFORMATION = np.diag(np.repeat([1e6, 1e4], 3))  # 1 mrad, 1 cm
ANGLES = 2.0 * np.pi * np.arange(COUNT) / COUNT
T_WORLD_KF = se3.exp(np.column_stack([np.zeros((COUNT, 2)), ANGLES, np.zeros((COUNT, 3))]))
T_WORLD_KF[:, :3, 3] = 2.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), 0.0 * ANGLES])


def places(count=COUNT, taken=()):
    motion = RelativePose(np.eye(4), INFORMATION)
    none = np.zeros((0, 4), np.float32), np.zeros(0, bool), np.zeros((0, 3), np.float32)
    true = LoopAttempt(50, 1, 0.9, Verification(motion, *none), motion)
    return Places(dict(enumerate(T_WORLD_KF[:count])), [true], taken, MIN_GAP, MIN_ERROR_M)


def injected(kind, wanted, seed=0, **of):
    return false_loops(places(**of), kind, wanted, np.random.default_rng(seed))


def off_m(loop):
    """Return where a loop puts its query off its true place, (3,) metres, reference frame."""
    T_true = se3.inverse(T_WORLD_KF[loop.match_id]) @ T_WORLD_KF[loop.query_id]
    return (loop.outcome.T_ref_query - T_true)[:3, 3]


@pytest.mark.parametrize("kind", [SCATTERED, CLUSTERS])
def test_they_are_as_many_as_wanted_false_and_no_neighbours(kind):
    found = injected(kind, 35)
    assert len({(each.match_id, each.query_id) for each in found}) == 35
    assert all(each.query_id - each.match_id > MIN_GAP for each in found)
    assert all(np.linalg.norm(off_m(each)) > MIN_ERROR_M for each in found)
    assert all(each.verification.outcome is each.outcome for each in found)


def test_more_begin_with_the_same_ones_and_another_seed_has_others():
    pairs = [
        [(each.match_id, each.query_id) for each in injected(CLUSTERS, wanted, seed)]
        for wanted, seed in ((12, 0), (30, 0), (12, 1))
    ]
    assert pairs[0] == pairs[1][:12] and pairs[0] != pairs[2]


def test_those_of_a_cluster_agree_with_each_other_and_scattered_ones_do_not():
    def spread_m(kind):
        """Return how far apart those in a row put the second way, seen from the first."""
        T = [
            T_WORLD_KF[each.match_id]
            @ each.outcome.T_ref_query
            @ se3.inverse(T_WORLD_KF[each.query_id])
            for each in injected(kind, 10)
        ]
        return np.ptp([each[:3, 3] for each in T], axis=0).max()

    assert spread_m(CLUSTERS) < 0.1 < 1.0 < spread_m(SCATTERED)


def test_what_is_known_otherwise_is_left_alone_and_a_small_map_has_none():
    first = injected(SCATTERED, 5)
    taken = {(each.match_id, each.query_id) for each in first}
    again = injected(SCATTERED, 5, taken=taken)
    assert not taken & {(each.match_id, each.query_id) for each in again}
    assert injected(SCATTERED, 5, count=4) == []

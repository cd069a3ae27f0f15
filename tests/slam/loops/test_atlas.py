# SPDX-License-Identifier: Apache-2.0
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest

from slam.external_odometry.comparison import GivenKeyframe
from slam.geometry import se3
from slam.loops.atlas import Atlas, LargestSubmap, odometry_frames
from slam.loops.correction import Correction
from slam.loops.submaps import NEEDED_PLACES
from slam.pose_graph import GraphSolution, solve
from slam.types import (
    FloatArray,
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    Verification,
)

INFORMATION = np.diag([1e5] * 3 + [1e4] * 3)
CUBE_M = 0.05 * np.array(list(product((-1.0, 1.0), repeat=3)))
SEEN_M = CUBE_M + np.array([0.0, 0.0, 1.0])  # a step further is another place
STEP = se3.exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.3]))
T_WORLD_OF = {  # where each segment really begins
    0: np.eye(4),
    1: se3.exp(np.array([0.3, -1.2, 0.4, 2.0, 1.0, -3.0])),
    2: se3.exp(np.array([0.0, 2.8, 0.1, -1.0, 0.0, 2.0])),
}


class Solved(NamedTuple):
    """The largest submap and what its graph says."""

    largest: LargestSubmap
    solution: GraphSolution
    T_world_kf: FloatArray
    weights: dict[int, float]
    links: Sequence[Link]
    unjoined: dict[int, int]


class Run:
    """Segments of a path, added keyframe by keyframe to an atlas that only sees motions."""

    def __init__(self):
        self.atlas = Atlas()
        self.keyframes, self.links, self.T_truth = [], [], []
        self.loops = 0

    def add(self, segment, loops=()):
        """Add the segment's next keyframe; loops are a match and what it moves the query by."""
        before = [each for each in self.keyframes if each.segment == segment]
        k, T_odom_cam, links = len(self.keyframes), np.eye(4), ()
        if before:
            T_odom_cam = before[-1].T_odom_cam @ STEP
            links = (Link(before[-1].id, k, RelativePose(STEP, INFORMATION)),)
        keyframe = Keyframe(k, float(k), T_odom_cam, None, None, segment=segment)
        self.keyframes.append(keyframe)
        self.T_truth.append(T_WORLD_OF[segment] @ T_odom_cam)
        attempts = {}
        for match_id, moved in loops:
            T_match_query = se3.inverse(self.T_truth[match_id]) @ moved @ self.T_truth[k]
            outcome = RelativePose(T_match_query, INFORMATION)
            seen = Verification(outcome, np.zeros((8, 4)), np.ones(8, np.bool_), SEEN_M)
            attempts[self.loops] = LoopAttempt(k, match_id, 0.9, seen, outcome)
            self.loops += 1
        self.atlas.add(keyframe, links, attempts)

    def finish(self, frames=None):
        count = len(self.keyframes)
        largest = self.atlas.largest(frames or dict.fromkeys(range(count), 1))
        solution = solve(largest.graph, 0.95)
        T_world_kf = np.full((count, 4, 4), np.nan)
        T_world_kf[list(solution.T_world_kf)] = list(solution.T_world_kf.values())
        links = largest.graph.links
        return Solved(largest, solution, T_world_kf, solution.weights, links, largest.unjoined)

    def errors_m(self, solution):
        placed = np.flatnonzero(np.isfinite(solution.T_world_kf[:, 0, 0]))
        T_first = self.T_truth[placed[0]]
        T_true = se3.inverse(T_first) @ np.array(self.T_truth)[placed]
        return se3.translation_norm(se3.inverse(T_true) @ solution.T_world_kf[placed])


TRUE = np.eye(4)
FALSE = se3.exp(np.array([0.5, 0.0, 0.0, 1.0, 0.0, 0.0]))
OTHERWISE_FALSE = se3.exp(np.array([0.0, -0.7, 0.0, 0.0, 1.5, 0.0]))
ALSO_FALSE = FALSE @ se3.exp(np.array([0.01, 0.0, 0.0, 0.0, 0.01, 0.0]))


@pytest.fixture
def run():
    return Run()


def placed(solution):
    return np.isfinite(solution.T_world_kf).all(axis=(1, 2)).tolist()


def test_one_segment_is_one_part(run):
    for k in range(6):
        run.add(0, [(0, TRUE)] if k == 5 else [])
    solution = run.finish()
    assert run.errors_m(solution).max() < 1e-6 and len(solution.T_world_kf) == 6
    assert solution.weights == {0: pytest.approx(1.0)} and not solution.unjoined
    assert [(link.ref_id, link.query_id) for link in solution.links] == [
        (k, k + 1) for k in range(5)
    ]


def test_a_segment_that_no_loop_reaches_has_no_place(run):
    for segment in (0, 0, 0, 1, 1):
        run.add(segment)
    solution = run.finish()
    assert placed(solution) == [True] * 3 + [False] * 2
    assert len(solution.links) == 2


def test_loops_at_one_place_join_nothing_and_those_at_two_do(run):
    for segment in (0, 0, 0, 1, 1):
        run.add(segment)
    run.add(1, [(1, TRUE)])
    solution = run.finish()
    assert placed(solution) == [True] * 3 + [False] * 3
    assert solution.unjoined == {0: 1} and solution.unjoined[0] < NEEDED_PLACES
    run.add(1, [(1, TRUE)])
    run.add(1, [(1, TRUE)])
    solution = run.finish({0: 1})
    assert placed(solution) == [True] * 3 + [False] * 5
    assert solution.unjoined == {0: 1, 1: 1, 2: 1}
    run.add(1, [(2, TRUE)])
    solution = run.finish()
    assert all(placed(solution)) and not solution.unjoined
    assert run.errors_m(solution).max() < 1e-6
    assert solution.weights == {k: pytest.approx(1.0) for k in range(4)}


def test_loops_that_contradict_each_other_join_nothing(run):
    for segment in (0, 0, 0, 1):
        run.add(segment)
    run.add(1, [(1, FALSE)])
    run.add(1, [(2, TRUE)])
    run.add(1, [(2, OTHERWISE_FALSE)])
    solution = run.finish()
    assert placed(solution) == [False] * 3 + [True] * 4  # four are more than three
    assert solution.unjoined == {0: 1, 1: 1, 2: 1}


@pytest.mark.parametrize("off", [[0.0, 0.35, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]])
def test_loops_that_differ_only_in_turn_or_only_in_place_contradict_each_other(run, off):
    for segment in (0, 0, 0, 1):
        run.add(segment)
    T_query = T_WORLD_OF[1] @ STEP @ STEP
    run.add(1, [(1, TRUE)])
    run.add(1, [(2, T_query @ se3.exp(np.array(off)) @ se3.inverse(T_query))])
    assert run.finish().unjoined == {0: 1, 1: 1}


def test_a_false_loop_among_true_ones_is_outvoted(run):
    for segment in (0, 0, 0, 1):
        run.add(segment)
    run.add(1, [(1, FALSE)])
    run.add(1, [(2, TRUE)])
    run.add(1, [(0, TRUE)])
    solution = run.finish()
    assert run.errors_m(solution).max() < 1e-4 and all(placed(solution))
    assert solution.weights[0] < 0.1 < 0.9 < min(solution.weights[1], solution.weights[2])


def test_a_wrong_join_is_undone_by_many_true_loops(run):
    for segment in (0,) * 8 + (1,):
        run.add(segment)
    run.add(1, [(1, FALSE)])
    run.add(1, [(2, ALSO_FALSE)])
    assert run.errors_m(run.finish()).max() > 0.5
    for k in range(8):
        run.add(1, [(k, TRUE), (7 - k, TRUE)])
    solution = run.finish()
    assert run.errors_m(solution).max() < 0.05
    assert max(solution.weights[0], solution.weights[1]) < 0.1


def test_later_segments_join_each_other_and_then_the_first(run):
    for segment in (0, 0, 0, 1, 1, 2):
        run.add(segment)
    run.add(2, [(3, TRUE)])
    run.add(2, [(4, TRUE)])
    solution = run.finish()
    assert placed(solution) == [False] * 3 + [True] * 5  # five are more than three
    assert run.errors_m(solution).max() < 1e-6
    np.testing.assert_allclose(solution.T_world_kf[3], np.eye(4), atol=1e-6)
    run.add(2, [(0, TRUE)])
    run.add(2, [(1, TRUE)])
    solution = run.finish()
    assert all(placed(solution)) and run.errors_m(solution).max() < 1e-6


def test_a_segment_that_is_taken_up_again_may_be_the_query_of_the_loops_that_join_it(run):
    for segment in (0, 0, 1, 1):
        run.add(segment)
    run.add(0, [(2, TRUE)])
    run.add(0, [(3, TRUE)])
    solution = run.finish()
    assert all(placed(solution)) and run.errors_m(solution).max() < 1e-6
    ties = [link for link in solution.links if {link.ref_id, link.query_id} & {2}]
    assert (ties[0].ref_id, ties[0].query_id) == (4, 2)


def test_the_part_with_most_frames_is_the_map_and_the_first_of_equals(run):
    for segment in (0, 0, 1, 1):
        run.add(segment)
    assert placed(run.finish()) == [True, True, False, False]
    assert placed(run.finish({0: 2, 1: 3, 2: 1, 3: 5})) == [False, False, True, True]
    solution = run.finish({3: 1})
    np.testing.assert_allclose(solution.T_world_kf[2], np.eye(4), atol=1e-9)


def test_loops_within_a_part_that_was_not_joined_are_of_no_use(run):
    for segment in (0, 0, 0, 0, 0, 1, 1):
        run.add(segment)
    run.add(1, [(5, TRUE)])
    assert run.finish().unjoined == {0: 0}
    run.add(1, [(1, TRUE)])
    assert run.finish().unjoined == {0: 1, 1: 1}


def test_the_correction_of_a_segment_is_known_once_it_is_joined(run):
    for segment in (0, 0, 0, 1):
        run.add(segment)

    def correction():
        solved = run.finish({0: 1})
        return solved.largest.correction(Correction(6, 2, {}, {}), 3, solved.solution)

    assert list(correction().T_world_odom) == [0]
    run.add(1, [(1, TRUE)])
    run.add(1, [(2, TRUE)])
    joined = correction()
    assert joined.version == 7 and joined.newest_id == 3 and len(joined.T_world_kf) == 6
    for segment, T_world_odom in joined.T_world_odom.items():
        np.testing.assert_allclose(T_world_odom, T_WORLD_OF[segment], atol=1e-6)


def test_an_odometry_from_elsewhere_stays_where_it_begins_until_it_can_be_judged(run):
    for _ in range(3):
        run.add(0)
    T_given_odom, bend = se3.exp(np.full(6, 0.5)), se3.exp(np.array([0.0, 0.0, 0.02, 0.0, 0.03, 0]))
    T_given_kf = [T_given_odom @ T @ (bend if k else np.eye(4)) for k, T in enumerate(run.T_truth)]
    run.atlas.give({k: GivenKeyframe(T) for k, T in enumerate(T_given_kf)})

    def T_world_given():
        solved = run.finish()
        return solved.largest.correction(beginning, 2, solved.solution).T_world_given

    beginning = Correction(0, -1, {}, {}, se3.inverse(T_given_odom))
    np.testing.assert_allclose(T_world_given(), se3.inverse(T_given_odom), atol=1e-6)
    run.add(0, [(0, TRUE)])  # a loop is something to correct it by
    assert np.abs(T_world_given() - se3.inverse(T_given_odom)).max() > 1e-3


def test_the_loops_of_one_keyframe_have_no_more_information_than_one(run):
    for segment in (0, 0, 0, 0):
        run.add(segment)
    run.add(0, [(0, TRUE), (1, TRUE), (2, TRUE), (3, TRUE)])
    run.add(0, [(0, TRUE)])
    loops = run.atlas.largest().graph.loops
    information = [loops[key].motion.information for key in range(5)]
    np.testing.assert_allclose(sum(information[:4]), INFORMATION)
    np.testing.assert_array_equal(information[4], INFORMATION)


def test_rejected_candidates_are_no_loops(run):
    for segment in (0, 0, 1):
        run.add(segment)
    keyframe = Keyframe(3, 3.0, np.eye(4), None, None, segment=2)
    rejection = Rejection(RejectionReason.FEW_MATCHES, 3, 20)
    attempts = {k: LoopAttempt(3, k, 0.9, None, rejection) for k in range(3)}
    run.atlas.add(keyframe, (), attempts)
    assert run.atlas.largest({0: 1}).unjoined == {}


def test_segments_are_tied_into_one_odometry_by_the_motion_that_joined_them(run):
    for segment in (0, 0, 0, 1, 1, 2):
        run.add(segment)
    run.add(2, [(3, TRUE)])
    run.add(2, [(4, TRUE)])
    run.add(2, [(0, TRUE)])
    run.add(2, [(1, TRUE)])
    links = run.finish().links
    T_odom_segment = odometry_frames(run.keyframes, links)
    T_odom_cam = [T_odom_segment[each.segment] @ each.T_odom_cam for each in run.keyframes]
    assert np.abs(np.array(T_odom_cam) - np.array(run.T_truth)).max() < 1e-6
    (alone,) = odometry_frames(run.keyframes[:3], links[:1]).items()
    assert alone[0] == 0 and (alone[1] == np.eye(4)).all()
    assert odometry_frames((), ()) == {}

# SPDX-License-Identifier: Apache-2.0
import hashlib
from dataclasses import dataclass

import numpy as np
import pytest

from slam.geometry import se3
from slam.pose_graph import GraphSolution, PoseGraph, solve, solve_beside
from slam.pose_graph.robust import solve_robustly
from slam.types import FloatArray, Link, RelativePose

KEYFRAMES_PER_ROUND = 30
PROBABILITY = 0.95
SIGMAS = np.array([0.003, 0.003, 0.003, 0.01, 0.01, 0.01])
INFORMATION = np.diag(1.0 / SIGMAS**2)


@dataclass
class Walk:
    """Two rounds on a circle of about 5 m across, seen by a noisy odometry."""

    T_world_cam: list[FloatArray]
    links: list[Link]
    rng: np.random.Generator

    def loop(self, ref_id: int, query_id: int) -> RelativePose:
        T_ref_query = se3.inverse(self.T_world_cam[ref_id]) @ self.T_world_cam[query_id]
        noise = se3.exp(self.rng.normal(size=6) * SIGMAS)
        return RelativePose(T_ref_query @ noise, INFORMATION)

    def false_loop(self) -> RelativePose:
        T_ref_query = se3.exp(self.rng.normal(size=6) * np.array([0.3, 0.3, 0.3, 1.0, 1.0, 1.0]))
        return RelativePose(T_ref_query, INFORMATION)

    def dead_reckoning(self) -> FloatArray:
        poses = [self.T_world_cam[0]]
        for link in self.links:
            poses.append(poses[-1] @ link.motion.T_ref_query)
        return np.array(poses)

    def graph(self, loops: dict[int, Link] | None = None) -> PoseGraph:
        return PoseGraph(dict(enumerate(self.dead_reckoning())), self.links, loops or {})

    def rmse_m(self, T_world_kf: dict[int, FloatArray] | FloatArray) -> float:
        poses = np.array([T_world_kf[k] for k in range(len(self.T_world_cam))])
        errors = poses[:, :3, 3] - np.array(self.T_world_cam)[:, :3, 3]
        return float(np.sqrt((errors**2).sum(axis=1).mean()))


@pytest.fixture
def walk() -> Walk:
    rng = np.random.default_rng(7)
    step = se3.exp(np.array([0.0, 2.0 * np.pi / KEYFRAMES_PER_ROUND, 0.0, 0.5, 0.0, 0.0]))
    poses = [np.eye(4)]
    for _ in range(2 * KEYFRAMES_PER_ROUND - 1):
        poses.append(poses[-1] @ step)
    result = Walk(poses, [], rng)
    result.links += [Link(i, i + 1, result.loop(i, i + 1)) for i in range(len(poses) - 1)]
    return result


def loops_of(walk: Walk, false_every: int = 0) -> tuple[dict[int, Link], set[int]]:
    """Return one loop per keyframe of the second round, and the keys of the false ones."""
    false_keys = set(range(0, KEYFRAMES_PER_ROUND, false_every)) if false_every else set()
    loops = {}
    for key in range(KEYFRAMES_PER_ROUND):
        query_id = key + KEYFRAMES_PER_ROUND
        motion = walk.false_loop() if key in false_keys else walk.loop(key, query_id)
        loops[key] = Link(key, query_id, motion)
    return loops, false_keys


def kept(solution: GraphSolution) -> set[int]:
    return {key for key, weight in solution.weights.items() if weight > 0.5}


@pytest.fixture(params=[solve, solve_beside])
def any_solve(request):
    """Return either way to solve a graph, at the default share of true loops to keep."""
    return lambda graph: request.param(graph, PROBABILITY)


def test_loops_pull_the_drift_back(walk: Walk, any_solve) -> None:
    solution = any_solve(walk.graph(loops_of(walk)[0]))
    assert walk.rmse_m(solution.T_world_kf) < 0.5 * walk.rmse_m(walk.dead_reckoning())
    assert solution.warnings == ()
    assert all(0.0 <= weight <= 1.0 for weight in solution.weights.values())


@pytest.mark.parametrize("false_every", [2, 3, 10])
def test_false_loops_are_left_out_and_do_not_bend_the_map(walk, any_solve, false_every) -> None:
    loops, false_keys = loops_of(walk, false_every)
    solution = any_solve(walk.graph(loops))
    assert kept(solution).isdisjoint(false_keys)
    assert len(kept(solution)) >= 0.9 * (len(loops) - len(false_keys))
    assert walk.rmse_m(solution.T_world_kf) < 0.5 * walk.rmse_m(walk.dead_reckoning())


@pytest.mark.parametrize("false_every", [0, 2, 5])
def test_what_is_found_beside_tracking_is_what_is_found_in_the_end(walk, false_every) -> None:
    graph = walk.graph(loops_of(walk, false_every)[0])
    beside, end = solve_beside(graph, PROBABILITY), solve(graph, PROBABILITY)
    assert kept(beside) == kept(end)
    for k, T_world_kf in end.T_world_kf.items():
        np.testing.assert_allclose(beside.T_world_kf[k], T_world_kf, atol=1e-4)


def test_loops_that_contradict_nothing_are_believed(walk: Walk, any_solve) -> None:
    T = walk.T_world_cam
    exact = [Link(i - 1, i, exactly(T[i - 1], T[i])) for i in range(1, len(T))]
    loops = {key: Link(k, k + 30, exactly(T[k], T[k + 30])) for key, k in enumerate((2, 5))}
    solution = any_solve(PoseGraph(dict(enumerate(T)), exact, loops))
    assert solution.weights == {0: 1.0, 1: 1.0}
    assert solution.warnings == ()


def exactly(T_world_ref: FloatArray, T_world_query: FloatArray) -> RelativePose:
    return RelativePose(se3.inverse(T_world_ref) @ T_world_query, INFORMATION)


def test_all_false_loops_are_ignored_aloud(walk: Walk) -> None:
    solution = solve(walk.graph(loops_of(walk, false_every=1)[0]), PROBABILITY)
    assert set(solution.weights.values()) == {0.0}
    assert len(solution.warnings) == 1
    assert f"all {KEYFRAMES_PER_ROUND} loops" in solution.warnings[0]
    for k, T_world_kf in enumerate(walk.dead_reckoning()):
        np.testing.assert_allclose(solution.T_world_kf[k], T_world_kf, atol=1e-6)


def test_without_loops_the_odometry_is_returned_and_nothing_is_doubted(walk, any_solve) -> None:
    solution = any_solve(walk.graph())
    assert solution.weights == {}
    assert solution.warnings == ()
    for k, T_world_kf in enumerate(walk.dead_reckoning()):
        np.testing.assert_array_equal(solution.T_world_kf[k], T_world_kf)


def test_the_first_keyframe_stays_where_it_was_put(walk: Walk, any_solve) -> None:
    T_world_first = se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]))
    T_first_second = walk.links[0].motion.T_ref_query
    poses = {5: T_world_first, 3: T_world_first @ T_first_second}
    moved = T_first_second @ se3.exp(np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))
    loop = Link(5, 3, RelativePose(moved, INFORMATION))
    solution = any_solve(PoseGraph(poses, [Link(5, 3, walk.links[0].motion)], {0: loop}))
    np.testing.assert_allclose(solution.T_world_kf[5], T_world_first, atol=1e-6)
    # Both are as sure of themselves: they meet in the middle.
    middle = se3.log(se3.inverse(poses[3]) @ solution.T_world_kf[3])
    np.testing.assert_allclose(middle, [0, 0, 0, 0.005, 0, 0], atol=1e-4)


def test_information_weighs_rotation_and_translation_in_that_order(any_solve) -> None:
    sure = np.diag([1.0, 1.0, 1.0, 1e6, 1e6, 1e6])
    link = Link(0, 1, RelativePose(np.eye(4), np.eye(6)))
    loop = Link(0, 1, RelativePose(se3.exp(np.array([0.2, 0, 0, 0.002, 0, 0])), sure))
    solution = any_solve(PoseGraph({0: np.eye(4), 1: np.eye(4)}, [link], {0: loop}))
    pose = solution.T_world_kf[1]
    assert pose[0, 3] == pytest.approx(0.002, abs=1e-5)  # told by the sure translation
    assert se3.rotation_angle(pose) == pytest.approx(0.1, abs=1e-3)  # the mean of equal doubts


@pytest.mark.parametrize("which", [solve, solve_beside])
def test_two_runs_give_the_same_bytes(walk: Walk, which) -> None:
    graph = walk.graph(loops_of(walk, false_every=3)[0])
    digests = set()
    for _ in range(3):
        poses = np.array(list(which(graph, PROBABILITY).T_world_kf.values()))
        digests.add(hashlib.sha256(poses.tobytes()).hexdigest())
    assert len(digests) == 1


@pytest.mark.parametrize(("most", "schedules"), [(KEYFRAMES_PER_ROUND - 1, 1), (1000, 2)])
def test_a_large_map_is_weighed_by_the_quick_schedule_alone(walk, monkeypatch, most, schedules):
    asked = []

    def weigh(graph, initial, doubted, probability, schedules):
        asked.append(len(schedules))
        return solve_robustly(graph, initial, doubted, probability, schedules)

    monkeypatch.setattr("slam.pose_graph.weighing._MOST_FOR_LINEAR", most)
    monkeypatch.setattr("slam.pose_graph.weighing.solve_robustly", weigh)
    weights = solve(walk.graph(loops_of(walk)[0]), PROBABILITY).weights
    assert asked == [schedules]
    assert np.mean(np.array(list(weights.values())) > 0.9) >= 0.8

# SPDX-License-Identifier: Apache-2.0
import hashlib
from dataclasses import dataclass

import numpy as np
import pytest

from slam.config import GraphConfig
from slam.geometry import se3
from slam.pose_graph import GraphSolution, PoseGraph
from slam.pose_graph.robust import solve_robustly
from slam.types import FloatArray, Link, RelativePose, SlamError

KEYFRAMES_PER_ROUND = 30
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

    def graph(self) -> PoseGraph:
        graph = PoseGraph(GraphConfig())
        for i, guess in enumerate(self.dead_reckoning()):
            graph.add_keyframe(i, guess)
        for link in self.links:
            graph.add_link(link)
        return graph

    def rmse_m(self, poses: FloatArray) -> float:
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


def close(graph: PoseGraph, walk: Walk, false_every: int = 0) -> tuple[set[int], set[int]]:
    """Add one loop per keyframe of the second round; return the keys of true and false ones."""
    true_keys, false_keys = set(), set()
    for key in range(KEYFRAMES_PER_ROUND):
        is_false = bool(false_every) and key % false_every == 0
        motion = walk.false_loop() if is_false else walk.loop(key, key + KEYFRAMES_PER_ROUND)
        graph.add_loop(key, key, key + KEYFRAMES_PER_ROUND, motion)
        (false_keys if is_false else true_keys).add(key)
    return true_keys, false_keys


def kept(solution: GraphSolution) -> set[int]:
    return {key for key, weight in solution.weights.items() if weight > 0.5}


def test_loops_pull_the_drift_back(walk: Walk) -> None:
    graph = walk.graph()
    close(graph, walk)
    solution = graph.finish()
    assert walk.rmse_m(solution.T_world_kf) < 0.5 * walk.rmse_m(walk.dead_reckoning())
    assert solution.warnings == ()
    assert all(0.0 <= weight <= 1.0 for weight in solution.weights.values())


def test_false_loops_are_left_out_and_do_not_bend_the_map(walk: Walk) -> None:
    graph = walk.graph()
    true_keys, false_keys = close(graph, walk, false_every=2)
    solution = graph.finish()
    assert kept(solution).isdisjoint(false_keys)
    assert len(kept(solution)) >= 0.9 * len(true_keys)
    assert walk.rmse_m(solution.T_world_kf) < 0.5 * walk.rmse_m(walk.dead_reckoning())


def test_loops_that_contradict_nothing_are_believed(walk: Walk) -> None:
    graph = PoseGraph(GraphConfig())
    for i, T_world_cam in enumerate(walk.T_world_cam):
        graph.add_keyframe(i, T_world_cam)
    exact = RelativePose(se3.inverse(walk.T_world_cam[0]) @ walk.T_world_cam[1], INFORMATION)
    for i in range(1, len(walk.T_world_cam)):
        graph.add_link(Link(i - 1, i, exact))
    for key, (ref_id, query_id) in enumerate([(2, 32), (5, 35)]):
        T_ref_query = se3.inverse(walk.T_world_cam[ref_id]) @ walk.T_world_cam[query_id]
        graph.add_loop(key, ref_id, query_id, RelativePose(T_ref_query, INFORMATION))
    solution = graph.finish()
    assert solution.weights == {0: 1.0, 1: 1.0}
    assert solution.warnings == ()


def test_all_false_loops_are_ignored_aloud(walk: Walk) -> None:
    graph = walk.graph()
    close(graph, walk, false_every=1)
    solution = graph.finish()
    assert set(solution.weights.values()) == {0.0}
    assert len(solution.warnings) == 1
    assert f"all {KEYFRAMES_PER_ROUND} loops" in solution.warnings[0]
    np.testing.assert_allclose(solution.T_world_kf, walk.dead_reckoning(), atol=1e-6)


def test_without_loops_the_odometry_is_returned_and_nothing_is_doubted(walk: Walk) -> None:
    solution = walk.graph().finish()
    assert solution.weights == {}
    assert solution.warnings == ()
    np.testing.assert_allclose(solution.T_world_kf, walk.dead_reckoning(), atol=1e-6)


def test_poses_follow_while_running(walk: Walk) -> None:
    graph = PoseGraph(GraphConfig())
    graph.add_keyframe(0, np.eye(4))
    for link in walk.links:
        query_id = link.query_id
        T_world_guess = graph.T_world_kf(link.ref_id) @ link.motion.T_ref_query
        graph.add_keyframe(query_id, T_world_guess)
        graph.add_link(link)
        if query_id >= KEYFRAMES_PER_ROUND:
            ref_id = query_id - KEYFRAMES_PER_ROUND
            graph.add_loop(ref_id, ref_id, query_id, walk.loop(ref_id, query_id))
        graph.update()
    running = np.array([graph.T_world_kf(i) for i in range(2 * KEYFRAMES_PER_ROUND)])
    finished = graph.finish().T_world_kf
    np.testing.assert_allclose(running, finished, atol=0.02)
    assert walk.rmse_m(running) < 0.5 * walk.rmse_m(walk.dead_reckoning())


def test_a_side_link_counts_as_soon_as_it_is_there(walk: Walk) -> None:
    graph = PoseGraph(GraphConfig())
    for i, guess in enumerate(walk.dead_reckoning()[:3]):
        graph.add_keyframe(i, guess)
        if i:
            graph.add_link(walk.links[i - 1])
        graph.update()
    before = graph.T_world_kf(2)
    graph.add_link(Link(0, 2, RelativePose(before @ se3.exp(0.1 * SIGMAS), 100.0 * INFORMATION)))
    graph.update()
    moved = se3.log(se3.inverse(before) @ graph.T_world_kf(2))
    np.testing.assert_allclose(moved, 0.1 * SIGMAS, rtol=0.2)


def test_a_good_guess_is_not_needed(walk: Walk) -> None:
    graph = PoseGraph(GraphConfig())
    for i in range(len(walk.T_world_cam)):
        graph.add_keyframe(i, np.eye(4))
    for link in walk.links:
        graph.add_link(link)
    close(graph, walk)
    assert walk.rmse_m(graph.finish().T_world_kf) < 0.5 * walk.rmse_m(walk.dead_reckoning())


def test_a_wrong_co_visibility_link_is_left_out_too(walk: Walk) -> None:
    graph = walk.graph()
    for i in range(0, len(walk.T_world_cam) - 2, 2):
        is_wrong = i % 10 == 0
        graph.add_link(Link(i, i + 2, walk.false_loop() if is_wrong else walk.loop(i, i + 2)))
    close(graph, walk)
    assert walk.rmse_m(graph.finish().T_world_kf) < 0.5 * walk.rmse_m(walk.dead_reckoning())


def test_the_first_keyframe_stays_where_it_was_put(walk: Walk) -> None:
    T_world_first = se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]))
    graph = PoseGraph(GraphConfig())
    graph.add_keyframe(5, T_world_first)
    graph.add_keyframe(3, np.eye(4))
    graph.add_link(Link(3, 5, walk.links[0].motion))
    solution = graph.finish()
    np.testing.assert_allclose(solution.T_world_kf[0], T_world_first, atol=1e-9)
    expected = T_world_first @ se3.inverse(walk.links[0].motion.T_ref_query)
    np.testing.assert_allclose(solution.T_world_kf[1], expected, atol=1e-6)


def test_information_weighs_rotation_and_translation_in_that_order() -> None:
    sure = np.diag([1.0, 1.0, 1.0, 1e6, 1e6, 1e6])
    graph = PoseGraph(GraphConfig())
    graph.add_keyframe(0, np.eye(4))
    graph.add_keyframe(1, np.eye(4))
    graph.add_link(Link(0, 1, RelativePose(np.eye(4), np.eye(6))))
    graph.add_link(Link(0, 1, RelativePose(se3.exp(np.array([0.2, 0, 0, 0.2, 0, 0])), sure)))
    pose = graph.finish().T_world_kf[1]
    assert pose[0, 3] == pytest.approx(0.2, abs=1e-4)  # told by the sure translation
    assert se3.rotation_angle(pose) == pytest.approx(0.1, abs=1e-3)  # the mean of equal doubts


def test_a_graph_may_be_empty_or_hold_one_keyframe() -> None:
    assert PoseGraph(GraphConfig()).finish().T_world_kf.shape == (0, 4, 4)
    graph = PoseGraph(GraphConfig())
    graph.add_keyframe(0, np.eye(4))
    graph.update()
    np.testing.assert_allclose(graph.finish().T_world_kf, [np.eye(4)], atol=1e-12)


def test_a_keyframe_without_a_link_is_named(walk: Walk) -> None:
    graph = walk.graph()
    graph.add_keyframe(99, np.eye(4))
    for solve in (graph.update, graph.finish):
        with pytest.raises(SlamError, match="keyframe 99 is not connected"):
            solve()


def test_wrong_use_is_named(walk: Walk) -> None:
    graph = walk.graph()
    motion = walk.links[0].motion
    graph.add_loop(0, 0, 30, motion)
    with pytest.raises(ValueError, match="loop 0 is in the pose graph already"):
        graph.add_loop(0, 1, 31, motion)
    with pytest.raises(ValueError, match="keyframe 77 is not in the pose graph"):
        graph.add_loop(1, 0, 77, motion)
    with pytest.raises(ValueError, match="keyframe 77 is not in the pose graph"):
        graph.add_link(Link(77, 0, motion))
    with pytest.raises(ValueError, match="keyframe 3 is in the pose graph already"):
        graph.add_keyframe(3, np.eye(4))
    graph.add_keyframe(88, np.eye(4))
    graph.add_keyframe(89, np.eye(4))
    with pytest.raises(ValueError, match="link 88 - 89 is not connected"):
        graph.add_link(Link(88, 89, motion))


def test_two_runs_give_the_same_bytes(walk: Walk) -> None:
    digests = set()
    states = walk.rng.bit_generator.state
    for _ in range(3):
        walk.rng.bit_generator.state = states
        graph = walk.graph()
        close(graph, walk, false_every=3)
        graph.update()
        digests.add(hashlib.sha256(graph.finish().T_world_kf.tobytes()).hexdigest())
    assert len(digests) == 1


@pytest.mark.parametrize(("most", "schedules"), [(KEYFRAMES_PER_ROUND - 1, 1), (1000, 2)])
def test_a_large_map_is_weighed_by_the_quick_schedule_alone(walk, monkeypatch, most, schedules):
    asked = []

    def weigh(graph, initial, doubted, probability, schedules):
        asked.append(len(schedules))
        return solve_robustly(graph, initial, doubted, probability, schedules)

    monkeypatch.setattr("slam.pose_graph.graph._MOST_FOR_LINEAR", most)
    monkeypatch.setattr("slam.pose_graph.graph.solve_robustly", weigh)
    graph = walk.graph()
    true_keys, _ = close(graph, walk)
    weights = graph.finish().weights
    assert asked == [schedules]
    assert np.mean([weights[key] > 0.9 for key in true_keys]) >= 0.8

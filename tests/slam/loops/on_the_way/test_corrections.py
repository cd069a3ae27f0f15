# SPDX-License-Identifier: Apache-2.0
import numpy as np

from slam.config import Config
from slam.geometry import se3
from slam.loops.atlas import LargestSubmap
from slam.loops.on_the_way.corrections import CorrectionsOnTheWay
from slam.loops.stage_clock import StageClock
from slam.pose_graph import PoseGraph
from slam.types import Link, RelativePose

PROBABILITY = Config().graph.inlier_probability
SIGMAS = np.array([0.001] * 3 + [0.003] * 3)
STEP = se3.exp(np.array([0.0, 2.0 * np.pi / 200, 0.0, 0.1, 0.0, 0.0]))


def test_a_long_way_closes_right_after_the_whole_was_solved():
    """Too few keyframes see where it began to take up all that the odometry drifted."""
    rng = np.random.default_rng(0)
    T_true = [np.linalg.matrix_power(STEP, k) for k in range(212)]

    def measured(a, b):
        T_a_b = se3.inverse(T_true[a]) @ T_true[b] @ se3.exp(rng.normal(size=6) * SIGMAS)
        return Link(a, b, RelativePose(T_a_b, np.diag(1.0 / SIGMAS**2)))

    links, T_odom_kf = [measured(k, k + 1) for k in range(211)], [np.eye(4)]
    for link in links:
        T_odom_kf.append(T_odom_kf[-1] @ link.motion.T_ref_query)
    nearby = [measured(k, k + 12) for k in range(0, 180, 20)]
    loops = dict(enumerate([*nearby, *(measured(k - 200, k) for k in range(200, 212))]))
    on_the_way = CorrectionsOnTheWay(PROBABILITY, StageClock())
    for count in (199, 204):
        T_kf = dict(enumerate(T_odom_kf[:count]))
        known = {key: each for key, each in loops.items() if each.query_id < count}
        of = PoseGraph(T_kf, links[: count - 1], known)
        largest = LargestSubmap(of, {}, T_kf, dict.fromkeys(T_kf, 0), None, {})
        on_the_way.add(count - 1, largest, largest)
    on_the_way.catch_up()
    T_world_cam = on_the_way.all[-1].T_world_odom[0] @ T_odom_kf[203]
    off_m = np.linalg.norm((T_odom_kf[203] - T_true[203])[:3, 3])
    assert np.linalg.norm((T_world_cam - T_true[203])[:3, 3]) < 0.1 * off_m


def test_a_part_leaves_a_wrong_place_once_most_loops_are_elsewhere(monkeypatch):
    """Two loops that agree had joined it there; where all begins there, true ones do not fit."""
    monkeypatch.setattr("slam.pose_graph.motion_system._MOST_FROM_NOTHING", 10)
    rng, cut, per_round = np.random.default_rng(0), 80, 40
    step = se3.exp(np.array([0.0, 2.0 * np.pi / per_round, 0.0, 0.5, 0.0, 0.0]))
    T_true = [np.linalg.matrix_power(step, k) for k in range(126)]
    aside = se3.exp(np.array([0.0, 0.6, 0.0, 2.0, 0.0, 0.0]))
    sigmas = np.array([0.003] * 3 + [0.01] * 3)

    def measured(a, b, T_off):
        noise = se3.exp(rng.normal(size=6) * sigmas)
        T_a_b = se3.inverse(T_true[a]) @ T_off @ T_true[b] @ noise
        return Link(a, b, RelativePose(T_a_b, np.diag(1.0 / sigmas**2)))

    links = [measured(k, k + 1, np.eye(4)) for k in range(125)]
    false = [measured(10, cut + 2, aside), measured(14, cut + 6, aside)]
    true = [measured(k % per_round, k, np.eye(4)) for k in range(cut + 20, 126)]
    on_the_way = CorrectionsOnTheWay(PROBABILITY, StageClock())
    for count, T_join in ((101, aside), (126, np.eye(4))):
        T_kf = {k: T if k < cut else T_join @ T for k, T in enumerate(T_true[:count])}
        join = se3.inverse(T_kf[cut - 1]) @ T_kf[cut]
        here = [each for each in links[: count - 1] if each.query_id != cut]
        here.insert(cut - 1, Link(cut - 1, cut, RelativePose(join, np.eye(6))))
        loops = {k: each for k, each in enumerate([*false, *true]) if each.query_id < count}
        of, segments = PoseGraph(T_kf, here, loops), {k: int(k >= cut) for k in T_kf}
        largest = LargestSubmap(of, {}, dict(enumerate(T_true[:count])), segments, None, {})
        on_the_way.add(count - 1, largest, largest)
    on_the_way.catch_up()
    off = on_the_way.all[-1].T_world_odom[1] @ T_true[125] - T_true[125]
    assert np.linalg.norm(off[:3, 3]) < 0.2

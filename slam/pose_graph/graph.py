# SPDX-License-Identifier: Apache-2.0
"""The graph of keyframes: incremental while running, robust when loops arrive, exact at the end."""

from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config import GraphConfig
from slam.pose_graph.batch import optimize
from slam.pose_graph.robust import (
    LINEAR,
    SUPER_LINEAR,
    RobustSolution,
    contested_motions,
    doubts,
    solve_robustly,
)
from slam.types import MIN_TRUSTED_WEIGHT, FloatArray, Link, RelativePose, SlamError

_ANCHOR_NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
# While running, loops wait until there are this many more of them than at the last robust solve:
# the total cost then grows with the logarithm of their number.
_LOOP_GROWTH = 0.1
# The linear schedule is for small maps; with 10,000 loops the other alone takes minutes. Above so
# many doubted motions it is left out.
_MOST_FOR_LINEAR = 3000


@dataclass(frozen=True)
class GraphSolution:
    """What the finished graph says.

    Attributes:
        T_world_kf: (K, 4, 4) float64, metres, in the order in which keyframes were added.
        weights: trust per loop key, 0 (ignored) to 1.
        warnings: one sentence each.
    """

    T_world_kf: FloatArray
    weights: dict[int, float]
    warnings: tuple[str, ...]


class PoseGraph:
    """Keyframe poses connected by motions: odometry is believed, all others have to agree with it.

    The link that first connects a keyframe to those before it is its odometry. Further links
    (co-visibility) and loops are left out where they contradict the rest: the errors of measured
    motions have heavier tails than their information matrices say.

    The first keyframe stays where its guess puts it: the identity makes it the world.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self._ids: list[int] = []
        self._odometry = gtsam.NonlinearFactorGraph()
        self._side_links: list[gtsam.BetweenFactorPose3] = []
        self._side_weights: list[float] = []  # of the side links, in their order
        self._loops: dict[int, gtsam.BetweenFactorPose3] = {}
        self._weights: dict[int, float] = {}  # of the loops weighed so far
        self._chain = gtsam.Values()  # poses by odometry alone, where every robust solve starts
        self._values: gtsam.Values  # the best poses so far
        self._isam: gtsam.ISAM2 | None  # None where other loops hold than it knows
        self._take(gtsam.Values())

    def add_keyframe(self, keyframe_id: int, T_world_kf_guess: FloatArray) -> None:
        """Add a keyframe at a (4, 4) guess of its pose, in metres; links have to follow.

        Raises:
            ValueError: the id is taken.
        """
        if self._values.exists(keyframe_id):
            raise ValueError(f"keyframe {keyframe_id} is in the pose graph already")
        guess = gtsam.Pose3(T_world_kf_guess)
        if not self._ids:
            self._chain.insert(keyframe_id, guess)
            self._odometry.add(gtsam.PriorFactorPose3(keyframe_id, guess, _ANCHOR_NOISE))
        self._ids.append(keyframe_id)
        self._values.insert(keyframe_id, guess)
        self._new_values.insert(keyframe_id, guess)

    def add_link(self, link: Link) -> None:
        """Add a motion that is no loop, in the order of time: odometry first, then co-visibility.

        Raises:
            ValueError: a keyframe of it is not in the graph, or neither is connected to the first.
        """
        factor = self._factor(link.ref_id, link.query_id, link.motion)
        has_ref, has_query = self._chain.exists(link.ref_id), self._chain.exists(link.query_id)
        if has_ref and has_query:
            self._side_links.append(factor)
            self._side_weights.append(1.0)  # until it is weighed
        elif has_ref or has_query:
            self._odometry.add(factor)
            old_id, new_id, step = link.ref_id, link.query_id, factor.measured()
            if has_query:
                old_id, new_id, step = new_id, old_id, step.inverse()
            self._chain.insert(new_id, self._chain.atPose3(old_id).compose(step))
        else:
            raise ValueError(
                f"link {link.ref_id} - {link.query_id} is not connected to the first keyframe: "
                "add the links that connect one of the two before it"
            )
        self._new_factors.add(factor)

    def add_loop(self, key: int, ref_id: int, query_id: int, motion: RelativePose) -> None:
        """Add a loop under a key that its weight is found by; it may wait for later loops.

        Raises:
            ValueError: the key is taken or a keyframe is not in the graph.
        """
        if key in self._loops:
            raise ValueError(f"loop {key} is in the pose graph already")
        self._loops[key] = self._factor(ref_id, query_id, motion)

    def update(self) -> None:
        """Bring the poses up to date: incrementally, or robustly once enough new loops came.

        Raises:
            SlamError: links do not connect a keyframe to the first one.
        """
        self._check_connected()
        waiting = len(self._loops) - len(self._weights)
        if waiting > _LOOP_GROWTH * len(self._weights):
            self._take(self._weigh(SUPER_LINEAR)[0].values)
        elif self._new_values.size() or self._new_factors.size():
            self._follow()

    def finish(self) -> GraphSolution:
        """Weigh all loops once more with every means, polish, and say what there is to doubt.

        Raises:
            SlamError: links do not connect a keyframe to the first one.
        """
        self._check_connected()
        values = self._chain  # whatever `update` made of it: who asked on the way changes nothing
        warnings: tuple[str, ...] = ()
        if self._loops or self._side_links:
            is_large = len(self._side_links) + len(self._loops) > _MOST_FOR_LINEAR
            schedules = (SUPER_LINEAR,) if is_large else (SUPER_LINEAR, LINEAR)
            solution, graph, doubted = self._weigh(*schedules)
            values = solution.values
            contested = contested_motions(graph, self._chain, doubted, solution)
            weights = np.array(list(self._weights.values()))
            warnings = doubts(weights > MIN_TRUSTED_WEIGHT, contested[len(self._side_links) :])
        self._take(optimize(self._trusted(), values))
        poses = np.array([self.T_world_kf(each) for each in self._ids]).reshape(-1, 4, 4)
        return GraphSolution(poses, dict(self._weights), warnings)

    def T_world_kf(self, keyframe_id: int) -> FloatArray:
        """Return the (4, 4) float64 pose of a keyframe as of the last `update`, metres."""
        return np.asarray(self._values.atPose3(keyframe_id).matrix(), dtype=np.float64)

    def _weigh(
        self, *schedules: gtsam.GncScheduler
    ) -> tuple[RobustSolution, gtsam.NonlinearFactorGraph, list[int]]:
        """Weigh all motions but the odometry against each other, starting from the odometry.

        Returns what came out, the graph of all motions, and where in it those are that are doubted.
        """
        graph = self._odometry.clone()
        for factor in (*self._side_links, *self._loops.values()):
            graph.add(factor)
        doubted = list(range(self._odometry.size(), graph.size()))
        probability = self._config.inlier_probability
        solution = solve_robustly(graph, self._chain, doubted, probability, schedules)
        weights = solution.weights[doubted].tolist()
        count = len(self._side_links)
        self._side_weights = weights[:count]
        self._weights = dict(zip(self._loops, weights[count:], strict=True))
        return solution, graph, doubted

    def _trusted(self) -> gtsam.NonlinearFactorGraph:
        """Return the graph of the odometry and of those other motions that hold."""
        graph = self._odometry.clone()
        weighed_loops = [(self._loops[key], weight) for key, weight in self._weights.items()]
        side_links = zip(self._side_links, self._side_weights, strict=True)
        for factor, weight in (*side_links, *weighed_loops):
            if weight > MIN_TRUSTED_WEIGHT:
                graph.add(factor)
        return graph

    def _take(self, values: gtsam.Values, isam: gtsam.ISAM2 | None = None) -> None:
        """Take these poses, in which all motions so far are, for the best ones."""
        self._values, self._isam = values, isam
        self._new_values, self._new_factors = gtsam.Values(), gtsam.NonlinearFactorGraph()

    def _follow(self) -> None:
        """Let the incremental solver add what is new."""
        if self._isam is None:
            params = gtsam.ISAM2Params()
            params.setFactorization("QR")  # the default, Cholesky, fails on ill-conditioned graphs
            params.relinearizeSkip = 1
            params.setRelinearizeThreshold(0.01)
            self._isam = gtsam.ISAM2(params)
            self._new_factors, self._new_values = self._trusted(), self._values
        self._isam.update(self._new_factors, self._new_values)
        self._take(self._isam.calculateEstimate(), self._isam)

    def _factor(self, ref_id: int, query_id: int, motion: RelativePose) -> gtsam.BetweenFactorPose3:
        for each in (ref_id, query_id):
            if not self._values.exists(each):
                raise ValueError(f"keyframe {each} is not in the pose graph; add it first")
        noise = gtsam.noiseModel.Gaussian.Information(motion.information)
        return gtsam.BetweenFactorPose3(ref_id, query_id, gtsam.Pose3(motion.T_ref_query), noise)

    def _check_connected(self) -> None:
        for each in self._ids:
            if not self._chain.exists(each):
                raise SlamError(
                    f"keyframe {each} is not connected to the first keyframe by any link; "
                    "add one, with little information where the motion is uncertain"
                )

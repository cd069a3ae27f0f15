# SPDX-License-Identifier: Apache-2.0
"""The graph solved on the way, in a thread for which nobody waits."""

from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial

from slam.loops.atlas import LargestSubmap
from slam.loops.correction import Correction
from slam.loops.cost_of_odometry import borne_out
from slam.loops.on_the_way.schedule import CorrectionSchedule
from slam.loops.on_the_way.settled import Settled
from slam.loops.stage_clock import StageClock
from slam.pose_graph import GraphSolution, PoseGraph, solve_beside
from slam.types import FloatArray, Keyframe


class CorrectionsOnTheWay:
    """Corrects what loops were closed so far, one correction after the other.

    Attributes:
        all: each `Correction` of the run by its version; the first knows of no loop, the last holds
            now. In a large graph only the last tells where keyframes are, T_world_kf.
        solved: (4, 4) by keyframe id, what the last one was made of.
    """

    def __init__(self, inlier_probability: float, clock: StageClock) -> None:
        self._inlier_probability = inlier_probability
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="corrections")
        self._schedule = CorrectionSchedule()
        self._solving: list[Future[None]] = []
        self._settled = Settled()
        self.solved: Mapping[int, FloatArray] = {}
        self.all = [Correction(0, -1, {}, {})]

    def begin(self, first: Correction) -> None:
        """Take what is known before any loop."""
        self.all = [first]

    def is_due(self, newest: Keyframe, loops: Counter[int], has_given_pose: bool) -> bool:
        """Return whether to correct now, as `CorrectionSchedule` does."""
        return self._schedule.is_due(newest, loops, has_given_pose)

    def add(self, newest_id: int, largest: LargestSubmap, by_images: LargestSubmap) -> None:
        """Queue a correction: the largest submap, and the one by images alone, are solved."""
        self._solving.append(self._thread.submit(self._correct, newest_id, largest, by_images))

    def catch_up(self) -> None:
        """Wait for all that are queued; what one of them failed by is raised."""
        while self._solving:
            self._solving.pop(0).result()

    def wait(self) -> None:
        """Wait for all that are queued, whatever becomes of them."""
        wait(self._solving)

    def _correct(self, newest_id: int, largest: LargestSubmap, by_images: LargestSubmap) -> None:
        with self._clock.stage("correct"):
            settled = self._settled.of(largest.graph)
            found = borne_out(largest, by_images, partial(self._solve_beside, settled))
            if self.solved and self._settled.is_contradicted(*found):
                # From nothing: whoever begins at a mistake sees the truth as what does not fit.
                settled, self.solved = {}, {}
                found = borne_out(largest, by_images, partial(self._solve_beside, settled))
            largest, solution = found
            self._settled.take(largest, solution, is_whole=not settled)
        self.solved, before = solution.T_world_kf, self.all[-1]
        self.all.append(largest.correction(before, newest_id, solution))
        if largest.graph.is_large:  # each has all keyframes again, and the newest alone is asked
            self.all[-2] = replace(before, T_world_kf={})

    def _solve_beside(self, settled: Mapping[int, FloatArray], graph: PoseGraph) -> GraphSolution:
        graph = replace(graph, solved=self.solved)
        return solve_beside(graph, self._inlier_probability, settled)

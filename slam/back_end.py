# SPDX-License-Identifier: Apache-2.0
"""Places, loops and the pose graph: worked on behind the tracker's back, one keyframe at a time."""

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placerec.recognizer import PlaceRecognizer, RecognizerError
from slam import se3
from slam.calibration import Calibration
from slam.config import Config
from slam.loop_closure import LoopCloser
from slam.pose_graph import GraphSolution, PoseGraph
from slam.stage_clock import StageClock
from slam.types import (
    MIN_TRUSTED_WEIGHT,
    Camera,
    FloatArray,
    Keyframe,
    Link,
    LoopAttempt,
    RelativePose,
    SlamError,
)

_ROOM = 8  # keyframes in line: a camera that turns fast makes some in a row, and then fewer


@dataclass(frozen=True)
class ClosedLoops:
    """What all keyframes together say.

    Attributes:
        T_world_kf: (K, 4, 4).
        attempts: every loop candidate, with its final weight.
        warnings: one sentence each.
    """

    T_world_kf: FloatArray
    attempts: tuple[LoopAttempt, ...]
    warnings: tuple[str, ...]

    def trusted_pairs(self) -> list[tuple[int, int]]:
        """Return the (match, query) keyframe ids of the loops that hold."""
        return [
            (each.match_id, each.query_id)
            for each in self.attempts
            if (each.weight or 0.0) > MIN_TRUSTED_WEIGHT
        ]


class BackEnd:
    """Describes each keyframe's place, closes its loops and constrains the graph, in a thread.

    Tracking needs none of the answers, so it never waits for them, but for one thing: no more than
    a few keyframes may stand in line. So the work cannot pile up, and what comes out does not
    depend on who was faster. The graph is solved only when somebody asks: each solve takes longer
    than the one before.

    Attributes:
        keyframes, links: what was taken in completely.
    """

    def __init__(
        self, camera: Camera, recognizer: PlaceRecognizer, config: Config, clock: StageClock
    ) -> None:
        self._loop_closer = LoopCloser(camera, recognizer, config.loop, config.verification)
        self._graph = PoseGraph(config.graph)
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="loops")
        self._in_line: deque[Future[tuple[LoopAttempt, ...]]] = deque()
        self._failure: RecognizerError | None = None  # nothing after it is taken in
        self._attempts: list[LoopAttempt] = []
        self.keyframes: list[Keyframe] = []
        self.links: list[Link] = []

    @property
    def min_similarity(self) -> float:
        """The cosine from which candidates are verified."""
        return self._loop_closer.min_similarity

    @property
    def is_empty(self) -> bool:
        """Whether no keyframe was taken in and none is being worked on."""
        return not self.keyframes and not self._in_line

    def insert(self, keyframe: Keyframe, links: tuple[Link, ...], rgb: NDArray[np.uint8]) -> None:
        """Put a keyframe in line, once there is room.

        Raises:
            RecognizerError: the recognizer failed on one before; those until then are in the graph.
        """
        if len(self._in_line) == _ROOM:
            self._first_in_line()
        # A copy: cameras reuse their memory.
        self._in_line.append(self._thread.submit(self._take, keyframe, links, rgb.copy()))

    def settle(self) -> tuple[LoopAttempt, ...]:
        """Wait for all keyframes in line and return the loop candidates of the last one.

        Raises:
            RecognizerError: the recognizer failed on one; those until then are in the graph.
        """
        attempts: tuple[LoopAttempt, ...] = ()
        while self._in_line:
            attempts = self._first_in_line()
        return attempts

    def T_world_odom(self) -> FloatArray:
        """Return the (4, 4) correction of the odometry at the newest keyframe, as of now.

        Raises:
            SlamError: there is no keyframe yet.
            RecognizerError: the recognizer failed on a keyframe; without it, ask again.
        """
        self.settle()
        if not self.keyframes:
            raise SlamError("there is no keyframe yet that a correction could be known of")
        newest = self.keyframes[-1]
        with self._clock.stage("graph"):
            self._graph.update()
        return self._graph.T_world_kf(newest.id) @ se3.inverse(newest.T_odom_cam)

    def solve(self) -> ClosedLoops:
        """Weigh all loops once more and return what they make of the keyframes.

        Raises:
            RecognizerError: the recognizer failed on a keyframe; without it, ask again.
        """
        self.settle()
        with self._clock.stage("graph"):
            solution: GraphSolution = self._graph.finish()
        attempts = tuple(
            replace(attempt, weight=solution.weights.get(key))
            for key, attempt in enumerate(self._attempts)
        )
        return ClosedLoops(solution.T_world_kf, attempts, solution.warnings)

    def similarities(self) -> NDArray[np.float32]:
        """Return (K, K), the cosine between the embeddings of all keyframes."""
        return self._loop_closer.similarities()

    def calibration(self) -> Calibration | None:
        """Return what the recognizer was calibrated on beside what it met, where it says so."""
        return self._loop_closer.calibration()

    def _first_in_line(self) -> tuple[LoopAttempt, ...]:
        try:
            return self._in_line.popleft().result()
        except RecognizerError:
            self._in_line.clear()  # they end the same way, which nobody has to hear twice
            raise

    def _take(
        self, keyframe: Keyframe, links: tuple[Link, ...], rgb: NDArray[np.uint8]
    ) -> tuple[LoopAttempt, ...]:
        if self._failure:
            raise self._failure
        with self._clock.stage("describe"):
            embedding = self._describe(rgb)
        with self._clock.stage("close loops"):
            linked_ids = [link.ref_id for link in links]
            attempts = self._loop_closer.close(keyframe, embedding, linked_ids)
        with self._clock.stage("graph"):
            self._constrain(keyframe, links, attempts)
        self.keyframes.append(keyframe)
        self.links.extend(links)
        self._attempts.extend(attempts)
        return attempts

    def _describe(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        try:
            return self._loop_closer.describe(rgb)
        except RecognizerError as failure:
            self._failure = failure
            raise

    def _constrain(
        self, keyframe: Keyframe, links: Sequence[Link], attempts: Sequence[LoopAttempt]
    ) -> None:
        T_world_kf = np.eye(4)
        if links:
            T_world_kf = self._graph.T_world_kf(links[0].ref_id) @ links[0].motion.T_ref_query
        self._graph.add_keyframe(keyframe.id, T_world_kf)
        for link in links:
            self._graph.add_link(link)
        for key, attempt in enumerate(attempts, start=len(self._attempts)):
            if isinstance(attempt.outcome, RelativePose):
                self._graph.add_loop(key, attempt.match_id, attempt.query_id, attempt.outcome)

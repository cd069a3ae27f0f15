# SPDX-License-Identifier: Apache-2.0
"""Places, loops and the pose graph, one keyframe at a time, in a thread beside tracking."""

from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placerec.errors import RecognizerError
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.loops.atlas import Atlas
from slam.loops.loop_closure import LoopCloser
from slam.loops.submaps import NEEDED_LOOPS
from slam.stage_clock import StageClock
from slam.types import (
    MIN_TRUSTED_WEIGHT,
    Camera,
    FloatArray,
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RejectionReason,
)

_MAX_QUEUED = 8  # keyframes: a camera that turns fast makes some in a row, and then fewer


@dataclass(frozen=True)
class ClosedLoops:
    """The keyframes' poses and loops once the graph is solved.

    Attributes:
        T_world_kf: (K, 4, 4), NaN where no loops join a keyframe's submap to the largest.
        attempts: every loop candidate, with its final weight.
        links: the motions that are no loops, of the keyframes that have a place.
        warnings: one sentence each.
    """

    T_world_kf: FloatArray
    attempts: tuple[LoopAttempt, ...]
    links: tuple[Link, ...]
    warnings: tuple[str, ...]


class BackEnd:
    """Describes each keyframe's place, closes its loops and constrains the graph, in a thread.

    Tracking needs none of the answers and waits only where the queue of keyframes is full. So the
    work cannot pile up, and results do not depend on which thread was faster. The graph is solved
    only when somebody asks, since each solve takes longer than the one before.

    Attributes:
        keyframes: those that were taken in completely.
        loop_closer: what finds their loops; to be asked once the queue is empty.
    """

    def __init__(
        self, camera: Camera, recognizer: PlaceRecognizer, config: Config, clock: StageClock
    ) -> None:
        self.loop_closer = LoopCloser(camera, recognizer, config.loop, config.verification)
        self._atlas = Atlas(config.graph)
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="loops")
        self._queue: deque[Future[tuple[LoopAttempt, ...]]] = deque()
        self._failure: RecognizerError | None = None  # nothing after it is taken in
        self._attempts: list[LoopAttempt] = []
        self.keyframes: list[Keyframe] = []

    @property
    def is_empty(self) -> bool:
        """Whether no keyframe was taken in and none is being worked on."""
        return not self.keyframes and not self._queue

    def insert(self, keyframe: Keyframe, links: tuple[Link, ...], rgb: NDArray[np.uint8]) -> None:
        """Queue a keyframe, waiting for the oldest one where the queue is full.

        Raises:
            RecognizerError: the recognizer failed on one before; those until then are in the graph.
        """
        if len(self._queue) == _MAX_QUEUED:
            self._next_result()
        # A copy: cameras reuse their memory.
        self._queue.append(self._thread.submit(self._take, keyframe, links, rgb.copy()))

    def settle(self) -> tuple[LoopAttempt, ...]:
        """Wait for all queued keyframes and return the loop candidates of the last one.

        Raises:
            RecognizerError: the recognizer failed on one; those until then are in the graph.
        """
        attempts: tuple[LoopAttempt, ...] = ()
        while self._queue:
            attempts = self._next_result()
        return attempts

    def T_world_odom(self, frames: Mapping[int, int] | None = None) -> FloatArray:
        """Return the (4, 4) correction of the odometry at the newest keyframe, as of now.

        Frames are counted as for `solve`.

        Raises:
            SlamError: there is no keyframe yet, or its submap is not joined to the rest.
            RecognizerError: the recognizer failed on a keyframe; without it, ask again.
        """
        self.settle()
        with self._clock.stage("graph"):
            return self._atlas.T_world_odom(frames)

    def solve(self, frames: Mapping[int, int] | None = None) -> ClosedLoops:
        """Weigh all loops once more and return what they make of the keyframes.

        The largest submap is that with the most frames per keyframe id; default: one of each.

        Raises:
            RecognizerError: the recognizer failed on a keyframe; without it, ask again.
        """
        self.settle()
        with self._clock.stage("graph"):
            solution = self._atlas.finish(frames)
        attempts = tuple(
            _in_the_end(attempt, solution.weights.get(key), solution.unjoined.get(key))
            for key, attempt in enumerate(self._attempts)
        )
        return ClosedLoops(solution.T_world_kf, attempts, solution.links, solution.warnings)

    def similarities(self) -> NDArray[np.float32]:
        """Return (K, K), how alike all keyframes are, -1 to 1."""
        return self.loop_closer.similarities()

    def _next_result(self) -> tuple[LoopAttempt, ...]:
        try:
            return self._queue.popleft().result()
        except RecognizerError:
            self._queue.clear()  # they end the same way, which nobody has to hear twice
            raise

    def _take(
        self, keyframe: Keyframe, links: tuple[Link, ...], rgb: NDArray[np.uint8]
    ) -> tuple[LoopAttempt, ...]:
        if self._failure:
            raise self._failure
        try:
            with self._clock.stage("describe"):
                embedding = self.loop_closer.describe(rgb)
            with self._clock.stage("close loops"):
                linked_ids = [link.ref_id for link in links]
                attempts = self.loop_closer.close(keyframe, embedding, linked_ids)
        except RecognizerError as failure:
            self._failure = failure
            raise
        with self._clock.stage("graph"):
            self._atlas.add(keyframe, links, dict(enumerate(attempts, len(self._attempts))))
        self.keyframes.append(keyframe)
        self._attempts.extend(attempts)
        return attempts


def _in_the_end(attempt: LoopAttempt, weight: float | None, agreeing: int | None) -> LoopAttempt:
    """Return what the graph makes of a loop: in use, outvoted or not joined to the largest submap.

    The weight is None where the graph was not given the loop; `agreeing` loops say where its submap
    lies, None where that is the largest.
    """
    if agreeing is not None:
        return replace(attempt, outcome=Rejection(RejectionReason.UNJOINED, agreeing, NEEDED_LOOPS))
    if weight is None or weight > MIN_TRUSTED_WEIGHT:
        return replace(attempt, weight=weight)
    outvoted = Rejection(RejectionReason.OUTVOTED, weight, MIN_TRUSTED_WEIGHT)
    # The motion stays on record with the noise that the graph was told.
    seen = attempt.verification and replace(attempt.verification, outcome=attempt.outcome)
    return replace(attempt, verification=seen, outcome=outvoted, weight=weight)

# SPDX-License-Identifier: Apache-2.0
"""Places, loops and the pose graph, one keyframe at a time, in a thread beside tracking."""

import logging
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.external_odometry.comparison import GivenKeyframe
from slam.external_odometry.trust import Trust, Verdict
from slam.geometry import se3
from slam.geometry.freed_memory import give_back
from slam.loops.atlas import Atlas, LargestSubmap
from slam.loops.correction import Correction
from slam.loops.cost_of_odometry import borne_out
from slam.loops.evidence import Evidence
from slam.loops.loop_closure import LoopCloser
from slam.loops.on_the_way.corrections import CorrectionsOnTheWay
from slam.loops.outcomes import in_the_end, refusals
from slam.loops.saved_map import SavedMap
from slam.loops.stage_clock import StageClock
from slam.mapping.landmark_map import LandmarkMap
from slam.pose_graph import GraphSolution, PoseGraph, leave_one_out
from slam.types import (
    Camera,
    FloatArray,
    IntArray,
    Keyframe,
    Link,
    LoopAttempt,
)

_MAX_QUEUED = 8  # keyframes: a camera that turns fast makes some in a row, and then fewer
# What frames took between keyframes, which stay, lies in pieces that the system does not get back.
_TIDIED_AFTER = 128
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClosedLoops:
    """The keyframes' poses and loops once the graph is solved.

    Attributes:
        T_world_kf: (K, 4, 4), NaN where no loops join a keyframe's submap to the largest.
        T_world_kf_without: (K, 4, 4), the same by the odometry alone, and one from elsewhere if
            there is one, with segments laid where loops join them.
        attempts: every loop candidate, with its final weight.
        links: the motions that are no loops, of the keyframes that have a place.
        trust: what the images say of an odometry from elsewhere, None where there is none.
        steps: what that measured, as far as it is believed, of the same keyframes.
        warnings: one sentence each.
    """

    T_world_kf: FloatArray
    T_world_kf_without: FloatArray
    attempts: tuple[LoopAttempt, ...]
    links: tuple[Link, ...]
    warnings: tuple[str, ...]
    trust: Trust | None = None
    steps: tuple[Link, ...] = ()


class BackEnd:
    """Describes each keyframe's place, closes its loops and constrains the graph, in a thread.

    Tracking needs none of the answers and waits only where the queue of keyframes is full. So the
    work cannot pile up, and results do not depend on which thread was faster. Corrections on the
    way are solved whenever enough new loops came, and nobody waits for them.

    Attributes:
        keyframes: those that were taken in completely.
        attempts: every loop candidate so far, in the order they were looked at.
        loop_closer: what finds their loops; to be asked once the queue is empty.
    """

    def __init__(
        self, camera: Camera, recognizer: PlaceRecognizer, config: Config, clock: StageClock
    ) -> None:
        self.loop_closer = LoopCloser(camera, recognizer, config.loop, config.verification)
        self._inlier_probability = config.graph.inlier_probability
        self._atlas = Atlas()
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="loops")
        self._on_the_way = CorrectionsOnTheWay(self._inlier_probability, clock)
        self._queue: deque[Future[tuple[LoopAttempt, ...]]] = deque()
        self._failure: Exception | None = None  # nothing after it is taken in
        self.attempts: list[LoopAttempt] = []
        self.keyframes: list[Keyframe] = []
        self._evidence = Evidence()

    @property
    def corrections(self) -> Sequence[Correction]:
        """Each correction of the run, as `CorrectionsOnTheWay.all`."""
        return self._on_the_way.all

    def load(self, saved: SavedMap, is_world: bool = True) -> None:
        """Begin with an earlier map, as if its keyframes had been taken in, where it has them.

        By default it is the world, however much is added.
        """
        self.loop_closer.load(saved)
        self._atlas.load(saved, is_world)
        self.keyframes = list(saved.keyframes)
        self.attempts = list(saved.attempts)
        T_world_kf = {each.id: each.T_odom_cam for each in saved.keyframes}
        T_world_odom = {each.segment: np.eye(4) for each in saved.keyframes[:1]}
        self._on_the_way.begin(Correction(0, len(saved.keyframes) - 1, T_world_kf, T_world_odom))

    @property
    def is_empty(self) -> bool:
        """Whether no keyframe was taken in and none is being worked on."""
        return not self.keyframes and not self._queue

    def insert(
        self,
        keyframe: Keyframe,
        links: tuple[Link, ...],
        moved: Mapping[int, FloatArray],
        rgb: NDArray[np.uint8],
        given: GivenKeyframe | None = None,
    ) -> None:
        """Queue a keyframe, and where others were moved to; wait for the oldest of a full queue.

        An odometry from elsewhere may have it too.

        Raises:
            RecognizerError: the recognizer failed on one before; those until then are in the graph.
        """
        if self.is_empty:  # its camera is where the world begins
            T_world_odom = {keyframe.segment: se3.inverse(keyframe.T_odom_cam)}
            T_world_given = se3.inverse(given.T_given_cam) if given else None
            self._on_the_way.begin(Correction(0, -1, {}, T_world_odom, T_world_given))
        if len(self._queue) == _MAX_QUEUED:
            self._next_result()
        # A copy: cameras reuse their memory.
        job = self._thread.submit(self._take, keyframe, links, moved, rgb.copy(), given)
        self._queue.append(job)

    def recognize(self, rgb: NDArray[np.uint8], but_segment: int | None = None) -> list[int]:
        """Return the keyframes, of all that were queued, that look like an image, best first.

        Those of but_segment are left out. There are none once the recognizer failed on one, of
        which `settle` tells.

        Raises:
            RecognizerError: the recognizer failed on the (H, W, 3) RGB image.
        """
        return self._thread.submit(self._recognize, rgb, but_segment).result()

    def settle(self) -> tuple[LoopAttempt, ...]:
        """Wait for all queued keyframes and return the loop candidates of the last one.

        Raises:
            RecognizerError: the recognizer failed on one; those until then are in the graph.
        """
        attempts: tuple[LoopAttempt, ...] = ()
        while self._queue:
            attempts = self._next_result()
        return attempts

    def add_loops(self, attempts: Sequence[LoopAttempt]) -> None:
        """Take loop candidates that were looked at once all keyframes were taken in."""
        self._atlas.add_loops(dict(enumerate(attempts, len(self.attempts))))
        self.attempts.extend(attempts)
        self._evidence.tidy(self.attempts, len(self.keyframes))

    def catch_up(self) -> None:
        """Wait for the corrections by all loops that were closed so far.

        Raises:
            RecognizerError: the recognizer failed on a keyframe; without it, ask again.
        """
        self.settle()
        self._on_the_way.catch_up()

    def _catch_up_with_what_failed(self) -> None:
        # The end needs no correction on the way: one that failed is told by `catch_up` alone.
        self.settle()
        self._on_the_way.wait()

    def solve(
        self,
        T_odom_kf: Mapping[int, FloatArray],
        frames: Mapping[int, int] | None = None,
        given: Mapping[int, GivenKeyframe] | None = None,
    ) -> ClosedLoops:
        """Weigh all loops once more and return what they make of the keyframes.

        T_odom_kf has the (4, 4) poses, by keyframe id, that the odometry still changed; given,
        where one from elsewhere has keyframes, if that is better known now. The largest submap is
        that with the most frames per keyframe id; default: one of each.

        Raises:
            RecognizerError: the recognizer failed on a keyframe; without it, ask again.
        """
        self._catch_up_with_what_failed()
        with self._clock.stage("graph"):
            self._atlas.move(T_odom_kf)
            if given is not None:
                self._atlas.forget_given()
                self._atlas.give(given)
            largest, solution = borne_out(*self._largest(frames), self._solve)
            graph = largest.graph
            without = self._solve(replace(graph, loops={}))
            influences = leave_one_out(graph, solution.T_world_kf, solution.weights)
        attempts = tuple(
            replace(
                in_the_end(attempt, key, solution, largest.unjoined), influence=influences.get(key)
            )
            for key, attempt in enumerate(self.attempts)
        )
        T_world_kf = np.full((len(self.keyframes), 4, 4), np.nan)
        T_start_kf = T_world_kf.copy()
        for k, T in solution.T_world_kf.items():
            T_world_kf[k], T_start_kf[k] = T, without.T_world_kf[k]
        links, steps = tuple(graph.links), tuple(graph.steps)
        warnings = (*solution.warnings, *refusals(attempts))
        return ClosedLoops(T_world_kf, T_start_kf, attempts, links, warnings, largest.trust, steps)

    def saved(
        self,
        T_world_kf: FloatArray,
        attempts: Sequence[LoopAttempt],
        links: Sequence[Link],
        sessions: IntArray,
        frames: Mapping[int, int],
        the_map: LandmarkMap,
    ) -> SavedMap:
        """Return the map that (K, 4, 4) poses give a place, NaN where they do not, to go on from.

        The attempts have their final weights; sessions is (K,) the recording each keyframe is from,
        and frames how many were placed against each.

        Raises:
            RecognizerError: nothing tells its recognizer from others.
        """
        used = [key for key, each in enumerate(attempts) if each.rejection is None]
        keyframe_ids = np.arange(len(self.keyframes))
        whole = SavedMap(
            camera=the_map.camera,
            fingerprint=self.loop_closer.fingerprint,
            keyframes=tuple(self.keyframes),
            sessions=sessions,
            frames=np.array([frames.get(k, 0) for k in keyframe_ids.tolist()], np.int64),
            embeddings=self.loop_closer.embeddings,
            is_new=self.loop_closer.is_new(keyframe_ids),
            links=tuple(links),
            loops=tuple(self._atlas.loop(key) for key in used),
            attempts=tuple(attempts[key] for key in used),
            the_map=the_map,
        )
        return whole.placed(T_world_kf)

    def unsolved(self, T_odom_kf: Mapping[int, FloatArray]) -> ClosedLoops:
        """Return the keyframes as the last correction on the way has them, where it has them.

        It is for when they cannot be solved: no loop was weighed, and there are no links.
        """
        T_world_kf = np.full((len(self.keyframes), 4, 4), np.nan)
        for each in self.keyframes:
            if each.segment in (T_world_odom := self.corrections[-1].T_world_odom):
                T_world_kf[each.id] = T_world_odom[each.segment] @ T_odom_kf[each.id]
        return ClosedLoops(T_world_kf, T_world_kf.copy(), tuple(self.attempts), (), ())

    def solve_images(self, T_odom_kf: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
        """Return the (4, 4) poses by keyframe id that images alone tell, as in `solve`.

        Those not joined to the largest submap stay as in T_odom_kf, where the odometry has them.
        """
        self._catch_up_with_what_failed()
        self._atlas.move(T_odom_kf)
        graph = self._atlas.largest(with_given=False).graph
        return {**T_odom_kf, **self._solve(graph).T_world_kf}

    def _largest(
        self, frames: Mapping[int, int] | None = None
    ) -> tuple[LargestSubmap, LargestSubmap]:
        """Return the largest submap, and what it is by images alone, where that may matter."""
        largest = self._atlas.largest(frames)
        is_stiff = largest.trust is not None and largest.trust.verdict is Verdict.BORNE_OUT
        if not (is_stiff and largest.graph.loops):
            return largest, largest
        return largest, self._atlas.largest(frames, with_given=False)

    def _solve(self, graph: PoseGraph) -> GraphSolution:
        from slam.pose_graph import solve  # GTSAM, which only the end needs

        return solve(replace(graph, solved=self._on_the_way.solved), self._inlier_probability)

    def _next_result(self) -> tuple[LoopAttempt, ...]:
        try:
            return self._queue.popleft().result()
        except Exception:
            self._queue.clear()  # they end the same way, which nobody has to hear twice
            raise

    def _recognize(self, rgb: NDArray[np.uint8], but_segment: int | None) -> list[int]:
        if self._failure:
            return []
        with self._clock.stage("describe"):
            embedding = self.loop_closer.describe(rgb)
        with self._clock.stage("close loops"):
            return self.loop_closer.most_similar(embedding, but_segment)

    def _take(
        self,
        keyframe: Keyframe,
        links: tuple[Link, ...],
        moved: Mapping[int, FloatArray],
        rgb: NDArray[np.uint8],
        given: GivenKeyframe | None,
    ) -> tuple[LoopAttempt, ...]:
        if self._failure:
            raise self._failure
        try:
            with self._clock.stage("describe"):
                embedding = self.loop_closer.describe(rgb)
            with self._clock.stage("close loops"):
                linked_ids = [link.ref_id for link in links]
                attempts = self.loop_closer.close(keyframe, embedding, linked_ids)
        except Exception as failure:
            self._failure = failure
            raise
        self._atlas.add(keyframe, links, dict(enumerate(attempts, len(self.attempts))))
        self._atlas.move(moved)
        if given:
            self._atlas.give({keyframe.id: given})
        self.keyframes.append(keyframe)
        if len(self.keyframes) % _TIDIED_AFTER == 0:
            give_back()
        self.attempts.extend(attempts)
        self._evidence.tidy(self.attempts, len(self.keyframes))
        for attempt in attempts:
            if attempt.rejection is None:
                _log.info("keyframe %d sees keyframe %d again", attempt.query_id, attempt.match_id)
        if self._on_the_way.is_due(keyframe, self._atlas.loops, given is not None):
            self._on_the_way.add(keyframe.id, *self._largest())
        return attempts

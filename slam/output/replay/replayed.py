# SPDX-License-Identifier: Apache-2.0
"""A run once more, from what it measured and without its images.

What a killed one left is finished so, what a whole one decided is decided again, and loops that it
did not try are looked for.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.files import Progress
from slam.config import Config
from slam.datasets.pose_files import PoseFile, read_odometry
from slam.external_odometry.pose_feed import PoseFeed
from slam.loops.loop_closure import LoopCloser
from slam.loops.remembered import Remembered, proposed_pairs
from slam.output.journal import Header, Journal
from slam.result import Calibration, MoreLoops, SlamResult, ThresholdFit, compared
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import (
    FloatArray,
    Frame,
    Keyframe,
    LoopAttempt,
    Rejection,
    RejectionReason,
)

_MOST_ROUNDS = 3  # each looks at the next pairs, of a map that the loops of the last one corrected
_DROPPED = (
    "the loops that were found by looking again contradict the run: {} of its {} loops are not in"
    " use any more"
)


class ReplayedSlam(Slam):
    """Takes the frames of a journal, in their order, for what they were found to be."""

    def __init__(
        self, journal: Journal, config: Config, remembered: Remembered | None = None
    ) -> None:
        """Begin; what is remembered of the keyframes lets their loops be decided again.

        Those that the journal has are taken as they were found.
        """
        camera = journal.header.camera
        super().__init__(camera, _Nobody(journal.header.min_similarity), config)
        self._tracker = _RecordedTracking(journal, remembered)
        self._back_end.loop_closer = (
            _RememberedLoops(journal.header, remembered, config)
            if remembered and not journal.attempts
            else _RecordedLoops(journal, config)
        )
        shape = (camera.height, camera.width)
        self._rgb = np.zeros((*shape, 3), np.uint8)
        self._depth_m = np.zeros(shape, np.float32)

    def process_next(self, timestamp_s: float) -> None:
        """Take the next frame of the journal, which came at that time."""
        self.process(Frame(timestamp_s, self._rgb, self._depth_m))

    def finish(self) -> SlamResult:
        """Return what the run found out until it was killed; how long it took is not known."""
        return replace(super().finish(), elapsed_s=None, compiling_s=None, stage_seconds={})


class SearchingSlam(ReplayedSlam):
    """Looks for loops again once the map is solved, in few rounds, until none is found."""

    def __init__(
        self,
        journal: Journal,
        config: Config,
        remembered: Remembered,
        shown: Callable[[], AbstractContextManager[Progress]],
    ) -> None:
        """Begin; how many pairs of keyframes were looked at is shown, anew each round."""
        super().__init__(journal, config, remembered)
        self._kept = remembered
        self._shown = shown

    def finish(self) -> SlamResult:
        """Return what the run found out, and what there is once it looked again."""
        result = super().finish()
        before, rounds = result, 0
        while rounds < _MOST_ROUNDS and (attempts := self._look_again(result)):
            rounds += 1
            self._back_end.add_loops(attempts)
            if all(each.rejection for each in attempts):
                result = replace(result, attempts=(*result.attempts, *attempts))
                break
            result = super().finish()
        then = [each.rejection is None for each in before.attempts]
        now = [each.rejection is None for each in result.attempts[: len(then)]]
        dropped = sum(was and not stays for was, stays in zip(then, now, strict=True))
        more = MoreLoops(before.corrected, sum(then), dropped, rounds)
        told = (_DROPPED.format(dropped, sum(then)),) if dropped else ()
        return replace(result, more_loops=more, warnings=(*told, *result.warnings))

    def _look_again(self, result: SlamResult) -> list[LoopAttempt]:
        closer, keyframes = self._back_end.loop_closer, self._back_end.keyframes
        pairs = proposed_pairs(result, self._kept, closer.candidates, self._config.loop)
        attempts = []
        with self._shown() as progress:
            for done, pair in enumerate(pairs, 1):
                query, match = keyframes[pair.query_id], keyframes[pair.match_id]
                attempts.append(closer.verify(query, match, pair.similarity, pair.proposed_by))
                progress(done, len(pairs))
        return attempts


def replayed(
    journal: Journal,
    config: Config,
    poses: PoseFile | None,
    remembered: Remembered | None = None,
) -> ReplayedSlam:
    """Return a run with all frames of a journal processed, with poses from elsewhere if any."""
    return fed(ReplayedSlam(journal, config, remembered), journal, poses)


def fed(slam: ReplayedSlam, journal: Journal, poses: PoseFile | None) -> ReplayedSlam:
    """Return a run that took all frames of its journal, with poses from elsewhere if any."""
    feed = PoseFeed(slam, poses.trajectory if poses else None)
    for number, (timestamp_s, _) in enumerate(journal.frames):
        if number in journal.session_starts:  # before its poses
            slam.start_session()
        feed.until(timestamp_s)
        slam.process_next(timestamp_s)
    if journal.is_whole:
        feed.until(math.inf)
    return slam


def poses_again(journal: Journal, config: Config) -> PoseFile | None:
    """Return the poses from elsewhere that a run was given, None without.

    Raises:
        LoopcloseError: their file cannot be read any more.
    """
    if journal.header.odometry is None:
        return None
    stamps_s = np.array([timestamp_s for timestamp_s, _ in journal.frames])
    return read_odometry(Path(journal.header.odometry), stamps_s, config.input)


class _RecordedTracking:
    """Places each frame where it was placed when it came, and keyframes where they ended.

    Attributes:
        map: what the keyframes showed, None where it was not kept.
    """

    def __init__(self, journal: Journal, remembered: Remembered | None) -> None:
        self.map = remembered.the_map if remembered else None
        self._left = iter(journal.frames)
        self._last = journal.T_odom_kf
        self._T_odom_kf: dict[int, FloatArray] = {}

    def start_session(self) -> None:
        """Leave it: each frame tells its segment."""

    def track(
        self, frame: Frame, T_given_cam: FloatArray | None = None, is_keyframe: bool = False
    ) -> TrackedFrame | Rejection:
        _, tracked = next(self._left)
        if tracked is None:
            return Rejection(RejectionReason.FEW_MATCHES, np.nan, np.nan)
        self._T_odom_kf.update(tracked.moved)
        if keyframe := tracked.new_keyframe:
            self._T_odom_kf[keyframe.id] = keyframe.T_odom_cam
        return tracked

    def settle(self) -> None:
        """Leave it: where the last keyframe was adjusted to is on record."""

    def T_odom_kf(self, keyframe_ids: Iterable[int]) -> dict[int, FloatArray]:
        return {k: self._last.get(k, self._T_odom_kf[k]) for k in keyframe_ids}


class _Nobody:
    """A recognizer that is never asked."""

    def __init__(self, min_similarity: float) -> None:
        self.min_similarity = min_similarity

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        raise NotImplementedError


class _RememberedLoops(LoopCloser):
    """Looks for loops by the embeddings of a run, one keyframe after the other."""

    def __init__(self, header: Header, remembered: Remembered, config: Config) -> None:
        nobody = _Nobody(remembered.min_similarity)
        super().__init__(header.camera, nobody, config.loop, config.verification)
        self.certificate = header.certificate
        self._left = iter(remembered.embeddings)

    def describe(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        return next(self._left)


class _RecordedLoops(LoopCloser):
    """Finds the loops that were found."""

    def __init__(self, journal: Journal, config: Config) -> None:
        header = journal.header
        nobody = _Nobody(header.min_similarity)
        super().__init__(header.camera, nobody, config.loop, config.verification)
        self.certificate = header.certificate
        self._attempts = journal.attempts
        self._count = 0

    def describe(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.zeros(1, np.float32)

    def close(
        self, keyframe: Keyframe, embedding: NDArray[np.float32], linked_ids: Sequence[int] = ()
    ) -> tuple[LoopAttempt, ...]:
        self._count += 1
        attempts = tuple(self._attempts.get(keyframe.id, ()))
        if attempts and attempts[-1].min_similarity is not None:  # the last one counts
            self.min_similarity = attempts[-1].min_similarity
        return attempts

    def similarities(self) -> NDArray[np.float32]:
        size = len(compared(self._count))
        return np.full((size, size), np.nan, np.float32)

    def calibration(self, similarities: NDArray[np.float32]) -> Calibration | None:
        if self.certificate is None:
            return None
        return Calibration(self.certificate, np.empty(0, np.float32))

    def threshold(self) -> ThresholdFit | None:
        return None

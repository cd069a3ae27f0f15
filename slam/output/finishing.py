# SPDX-License-Identifier: Apache-2.0
"""A run once more, from its journal and without its images: what a killed one left is finished."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.loops.back_end import ClosedLoops
from slam.loops.loop_closure import LoopCloser
from slam.output.journal import Journal
from slam.result import Calibration, SlamResult, ThresholdFit, compared
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

NOT_ADJUSTED = (
    "this was made of what a run that was killed had left: the pose graph is solved, but the map is"
    " not adjusted to it, and there are no pictures and no point cloud"
)


class ReplayedSlam(Slam):
    """Takes the frames of a journal, in their order, for what they were found to be."""

    def __init__(self, journal: Journal, config: Config) -> None:
        camera = journal.header.camera
        super().__init__(camera, _Nobody(journal.header.min_similarity), config)
        self._journal = journal
        self._back_end.loop_closer = _RecordedLoops(journal, config)
        self._T_odom_kf: dict[int, FloatArray] = {}
        self._number = 0
        shape = (camera.height, camera.width)
        self._rgb = np.zeros((*shape, 3), np.uint8)
        self._depth_m = np.zeros(shape, np.float32)

    def process_next(self) -> None:
        """Take the next frame of the journal."""
        if self._number in self._journal.session_starts:
            self.start_session()
        timestamp_s, _ = self._journal.frames[self._number]
        self.process(Frame(timestamp_s, self._rgb, self._depth_m))

    def finish(self) -> SlamResult:
        """Return what the run found out until it was killed; how long it took is not known."""
        return replace(super().finish(), elapsed_s=0.0, stage_seconds={})

    def _track(
        self, frame: Frame, T_given_cam: FloatArray | None, is_keyframe: bool
    ) -> TrackedFrame | Rejection:
        _, tracked = self._journal.frames[self._number]
        self._number += 1
        if tracked is None:
            return Rejection(RejectionReason.FEW_MATCHES, np.nan, np.nan)
        self._T_odom_kf.update(tracked.moved)
        if keyframe := tracked.new_keyframe:
            self._T_odom_kf[keyframe.id] = keyframe.T_odom_cam
        return tracked

    def _tracked(self, keyframes: Sequence[Keyframe]) -> dict[int, FloatArray]:
        return {each.id: self._T_odom_kf[each.id] for each in keyframes}

    def _adjusted(self, loops: ClosedLoops) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
        return loops.T_world_kf, loops.T_world_kf_without, (NOT_ADJUSTED,)


class _Nobody:
    """A recognizer that is never asked."""

    def __init__(self, min_similarity: float) -> None:
        self.min_similarity = min_similarity

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        raise NotImplementedError


class _RecordedLoops(LoopCloser):
    """Finds the loops that were found."""

    def __init__(self, journal: Journal, config: Config) -> None:
        header = journal.header
        nobody = _Nobody(header.min_similarity)
        super().__init__(header.camera, nobody, config.loop, config.verification)
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
        return None

    def threshold(self) -> ThresholdFit | None:
        return None

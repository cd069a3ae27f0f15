# SPDX-License-Identifier: Apache-2.0
"""Runs under stress: tracked again where the images change, else decided again."""

import zlib
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from placerec.errors import LoopcloseError, RecognizerError
from placerec.files import Progress
from placerec.recognizer import load
from slam.config import Config
from slam.datasets import Sessions
from slam.evaluation.drift import trajectory_error
from slam.evaluation.motion_truth import judge_loops
from slam.evaluation.stress.false_loops import CLUSTERS, SCATTERED, Places, false_loops
from slam.evaluation.stress.images import IMAGE_STRESS
from slam.evaluation.stress.odometry_noise import drift
from slam.output.journal import Journal
from slam.output.replay.replayed import replayed
from slam.output.stress.clean_run import CleanRun, track
from slam.output.stress.outcome import Outcome
from slam.output.stress.stressors import CLEAN, ODOMETRY_NOISE
from slam.result import SlamResult
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import FloatArray, Frame, LoopAttempt, SlamError, Trajectory

Pairs = Collection[tuple[int, int]]


@dataclass(frozen=True)
class Bench:
    """What trials are made on.

    Attributes:
        sessions: the recording.
        recognizer: its name; each run has one of its own.
        config: the settings.
        seed: of everything random.
        clean: the run that nothing is wrong with.
    """

    sessions: Sessions
    recognizer: str
    config: Config
    seed: int
    clean: CleanRun

    def random(self, stressor: str, *of: int) -> np.random.Generator:
        """Return the generator of a stressor, the same at each level, or of one of its frames."""
        return np.random.default_rng([self.seed, zlib.crc32(stressor.encode()), *of])

    def clean_outcome(self) -> Outcome:
        """Return what the clean run is."""
        frames = len(self.clean.measured.journal.frames)
        return self._outcome(CLEAN, 0.0, self.clean.result, frames, ())

    def obstacle(self, stressor: str) -> str | None:
        """Return why a stressor cannot be tried, None if it can."""
        if stressor in (SCATTERED, CLUSTERS) and not self._true:
            return "the clean run verified no loop that a false one could be like"
        return None

    def tried(self, stressor: str, level: float, progress: Progress) -> Outcome:
        """Return what becomes of the run under stress."""
        if stressor in IMAGE_STRESS:
            return self._tracked(stressor, level, progress)
        if stressor == ODOMETRY_NOISE:
            return self._drifting(level)
        return self._fooled(stressor, level)

    def _tracked(self, stressor: str, level: float, progress: Progress) -> Outcome:
        change, given = IMAGE_STRESS[stressor], 0

        def stressed(frame: Frame, number: int) -> Frame | None:
            nonlocal given
            changed = change(frame, number, level, self.random(stressor, number))
            given += changed is not None
            return changed

        slam = Slam(self.sessions.camera, load(self.recognizer), self.config)
        try:
            track(slam, self.sessions, stressed, progress)
            result = slam.finish()
        except (SlamError, RecognizerError) as ended:  # nothing is tracked, or told apart
            unknown = (None, None, None, self.clean.has_truth)
            return Outcome(stressor, level, *unknown, given, 0, 0, 0, 0, (), str(ended))
        return self._outcome(stressor, level, result, given, ())

    def _fooled(self, stressor: str, level: float) -> Outcome:
        true, T_world_kf = self._true, self.clean.result.T_world_kf
        places = Places(
            {k: T for k, T in enumerate(T_world_kf) if np.isfinite(T).all()},
            true,
            {(each.match_id, each.query_id) for each in self.clean.attempts},
            self.config.loop.min_gap,
            self.config.evaluation.false_loop_translation_m,
        )
        wanted = max(1, round(len(true) * level / (1.0 - level)))
        injected = false_loops(places, stressor, wanted, self.random(stressor))
        result = self._decided([*self.clean.attempts, *injected], self.clean.measured.journal)
        pairs = {(each.match_id, each.query_id) for each in injected}
        outcome = self._outcome(stressor, level, result, self._given, pairs)
        if len(injected) == wanted:
            return outcome
        short = f"the map had room for {len(injected)} of {wanted} false loops"
        return replace(outcome, warnings=(short, *outcome.warnings))

    def _drifting(self, level: float) -> Outcome:
        journal = self.clean.measured.journal
        links = [link for _, each in journal.frames if each for link in each.links]
        moved = drift(journal.T_odom_kf, links, level, self.random(ODOMETRY_NOISE))
        frames = [(t, each and _moved(each, moved)) for t, each in journal.frames]
        T_odom_kf = {k: moved[k] @ T for k, T in journal.T_odom_kf.items()}
        journal = replace(journal, frames=frames, T_odom_kf=T_odom_kf)
        result = self._decided(self.clean.attempts, journal)
        return self._outcome(ODOMETRY_NOISE, level, result, self._given, ())

    @property
    def _true(self) -> list[LoopAttempt]:
        """Loops that geometry verified in the clean run."""
        return [each for each in self.clean.attempts if each.rejection is None]

    @property
    def _given(self) -> int:
        return len(self.clean.measured.journal.frames)

    def _decided(self, attempts: Collection[LoopAttempt], journal: Journal) -> SlamResult:
        """Decide again with loop candidates as they were found, and others as if they had been."""
        of_query: dict[int, list[LoopAttempt]] = {}
        for each in attempts:
            of_query.setdefault(each.query_id, []).append(each)
        journal = replace(journal, attempts=of_query)
        return replayed(journal, self.config, None, self.clean.measured.remembered).finish()

    def _outcome(
        self, stressor: str, level: float, result: SlamResult, given: int, injected: Pairs
    ) -> Outcome:
        in_use = [each.rejection is None for each in result.attempts]
        is_false = [(each.match_id, each.query_id) in injected for each in result.attempts]
        if self.clean.can_judge:
            by_truth = judge_loops(
                result.attempts, result.keyframes, self.clean.reference, self.config.evaluation
            )
            is_false = [a or bool(b.is_false) for a, b in zip(is_false, by_truth, strict=True)]
        false_kept = sum(use and false for use, false in zip(in_use, is_false, strict=True))
        return Outcome(
            stressor,
            level,
            self._error_m(result.odometry),
            self._error_m(result.without_loops),
            self._error_m(result.corrected),
            self.clean.has_truth,
            given,
            len(result.corrected),
            sum(in_use) - false_kept,
            len(injected),
            false_kept,
            (*result.missing, *result.warnings),
        )

    def _error_m(self, estimate: Trajectory) -> float | None:
        try:
            error = trajectory_error(estimate, self.clean.reference, self.config.evaluation)
        except LoopcloseError:  # too few poses
            return None
        return error.ate_rmse_m


def _moved(tracked: TrackedFrame, T: dict[int, FloatArray]) -> TrackedFrame:
    """Return a frame with its keyframes moved, and it with the one that it was placed against."""
    new = tracked.new_keyframe
    return replace(
        tracked,
        T_odom_cam=T[tracked.keyframe_id] @ tracked.T_odom_cam,
        new_keyframe=new and replace(new, T_odom_cam=T[new.id] @ new.T_odom_cam),
        moved={k: T[k] @ T_odom_cam for k, T_odom_cam in tracked.moved.items()},
    )

# SPDX-License-Identifier: Apache-2.0
"""The run that nothing is wrong with: what it measured, and what all others are compared with."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from placerec.files import Progress
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.datasets import Sessions
from slam.evaluation.drift import compare_drift
from slam.output.journal import Header, Journal
from slam.output.replay.measurements import Measurements, read_measurements, write_measurements
from slam.output.replay.replayed import replayed
from slam.result import SlamResult
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Frame, LoopAttempt, Rejection, SlamError, Trajectory

Change = Callable[[Frame, int], Frame | None]
"""What is done to a frame of a number; None drops it."""


@dataclass(frozen=True)
class CleanRun:
    """What a run without stress measured, and what was decided of it.

    Attributes:
        measured: what deciding again takes.
        attempts: its loop candidates before the graph weighed them.
        result: the decision.
        reference: the true camera poses as they were compared with, else those of the run.
        has_truth: whether they are true.
        can_judge: whether they tell which loops are false.
    """

    measured: Measurements
    attempts: tuple[LoopAttempt, ...]
    result: SlamResult
    reference: Trajectory
    has_truth: bool
    can_judge: bool


def track(
    slam: Slam, sessions: Sessions, change: Change, progress: Progress
) -> tuple[list[tuple[float, TrackedFrame | None]], set[int]]:
    """Let a camera give its frames, changed; return what became of each, and the session starts."""
    frames: list[tuple[float, TrackedFrame | None]] = []
    starts, number = set(), 0
    for recording in sessions.recordings:
        slam.start_session()
        starts.add(len(frames))
        for frame in recording:
            if (changed := change(frame, number)) is not None:
                tracked = slam.process(changed)
                placed = None if isinstance(tracked, Rejection) else tracked
                frames.append((frame.timestamp_s, placed))
            number += 1
            progress(number, len(sessions.timestamps_s))
    return frames, starts


def measure(
    sessions: Sessions,
    recognizer: PlaceRecognizer,
    config: Config,
    header: tuple[str, str],
    progress: Progress,
    path: Path,
) -> None:
    """Run on a recording, whose title and command are the header, and write what was measured.

    Raises:
        LoopcloseError: no frame could be tracked, or it cannot be written.
    """
    slam = Slam(sessions.camera, recognizer, config)
    told = Header(
        *header, sessions.camera, slam.min_similarity, None, sessions.warnings, slam.certificate
    )
    frames, starts = track(slam, sessions, lambda frame, _: frame, progress)
    slam.finish()
    journal = Journal(told, frames, starts, T_odom_kf=slam.T_odom_kf, is_whole=True)
    if slam.remembered is None:
        for attempt in slam.attempts:
            journal.attempts.setdefault(attempt.query_id, []).append(attempt)
    write_measurements(path, Measurements(journal, slam.remembered, sessions.ground_truth))


def decide(path: Path, config: Config) -> CleanRun:
    """Read what a run measured and decide what it did.

    Raises:
        LoopcloseError: it cannot be read.
    """
    measured = read_measurements(path, config)
    slam = replayed(measured.journal, config, None, measured.remembered)
    result, truth, can_judge = slam.finish(), None, False
    if measured.truth is not None:
        try:
            drift = compare_drift(result, measured.truth, config.evaluation)
            truth, can_judge = drift.truth, not drift.unjudged
        except SlamError:  # too few poses match, or they stay in one place
            pass
    reference = result.corrected if truth is None else truth
    return CleanRun(measured, tuple(slam.attempts), result, reference, truth is not None, can_judge)

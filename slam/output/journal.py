# SPDX-License-Identifier: Apache-2.0
"""What a run has done so far, on disk while it goes on: whoever is killed loses seconds."""

import errno
import json
import os
import threading
from collections import deque
from dataclasses import asdict, dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any, Self

import numpy as np

from placerec.certificate import Certificate
from placerec.errors import LoopcloseError, cause_of
from placerec.files import check_file
from slam.evaluation.trajectory import tum_lines
from slam.output.claimed_folder import JOURNAL
from slam.output.decision import Decision
from slam.output.journal_lines import Line, attempt_line, attempt_of, frame_line, frame_of
from slam.output.ledger.writing import ledger_line
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame, preview
from slam.types import (
    Camera,
    FloatArray,
    Frame,
    Keyframe,
    LoopAttempt,
    Rejection,
    SlamError,
    Trajectory,
)

_EVERY_S = 2.0
_MOST_BYTES = 1 << 32  # of a journal: a run of many hours


@dataclass(frozen=True)
class Header:
    """What a run is of.

    Attributes:
        title, command: as `write_run` takes them.
        camera: the camera.
        min_similarity: from which its loop candidates are verified.
        odometry: file of the poses from elsewhere, None without.
        warnings: what is to be said of the recordings; before a run's end, what is known so far.
        certificate: what the recognizer was calibrated on, None where nobody says so.
        earlier: folder of the map that it goes on from, None without.
    """

    title: str
    command: str
    camera: Camera
    min_similarity: float
    odometry: str | None
    warnings: tuple[str, ...]
    certificate: Certificate | None = None
    earlier: str | None = None


@dataclass(frozen=True)
class Journal:
    """What a run has done, as read back.

    Attributes:
        header: what the run is of.
        frames: in the order of time, with None for one that was not placed. Keyframes have neither
            features nor images.
        session_starts: positions in `frames` at which a session begins.
        T_odom_kf: (4, 4) by id, where the odometry had keyframes in the end; none of a killed run.
        is_whole: whether the run came to the end of its recordings.
        attempts: loop candidates by the id of the later keyframe, in the order they were looked at;
            without the pixels of their matches, and with the points of accepted loops alone.
    """

    header: Header
    frames: list[tuple[float, TrackedFrame | None]] = field(default_factory=list)
    session_starts: set[int] = field(default_factory=set)
    attempts: dict[int, list[LoopAttempt]] = field(default_factory=dict)
    T_odom_kf: dict[int, FloatArray] = field(default_factory=dict)
    is_whole: bool = False


class JournalWriter:
    """Writes what a run does into a folder, every two seconds, in a thread beside it; a context.

    `journal.jsonl` is for `read_journal`. For people there are `trajectory.txt`, where each frame
    was thought to be when it came, and `loops.jsonl`, what geometry alone says of the loops. All
    three only grow.

    Attributes:
        failure: why it cannot be written, None while it can.
    """

    def __init__(self, folder: Path, header: Header, slam: Slam) -> None:
        self.failure: Exception | None = None
        self._folder, self._slam, self._header = folder, slam, header
        self._news: deque[tuple[float, TrackedFrame | Rejection | None]] = deque()
        self._keyframes: dict[int, Keyframe] = {}
        self._attempts = 0
        if slam.earlier:
            self._keyframes = {each.id: each for each in slam.earlier.keyframes}
            self._attempts = len(slam.earlier.attempts)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._write_at_times, daemon=True, name="journal")

    def __enter__(self) -> Self:
        """Begin the files."""
        try:
            self._append(JOURNAL, [json.dumps(told_of(self._header))])
            self._append("trajectory.txt", tum_lines(_trajectory([]))[:1])
            self._append("loops.jsonl", [])
            self._thread.start()
        except (OSError, RuntimeError) as error:  # a full disk, no more threads
            self.failure = error
        return self

    def __exit__(self, *_: object) -> None:
        """Write what is not written yet."""
        self._is_over.set()
        if self._thread.ident is not None:
            self._thread.join()

    def start_session(self) -> None:
        """Take the next frame for the first of another recording."""
        self._news.append((np.nan, None))

    def add(self, frame: Frame, tracked: TrackedFrame | Rejection) -> None:
        """Add what became of a frame."""
        self._news.append((frame.timestamp_s, tracked))

    def _write_at_times(self) -> None:
        try:
            while not self._is_over.wait(_EVERY_S):
                self._write()
            self._write()
        except Exception as error:  # the run is worth more than its journal
            self.failure = error

    def _write(self) -> None:
        lines: list[Line] = []
        poses: list[tuple[float, FloatArray]] = []
        while self._news:
            timestamp_s, tracked = self._news.popleft()
            if tracked is None:
                lines.append({"session": True})
            elif isinstance(tracked, Rejection):
                lines.append({"lost": timestamp_s})
            else:
                lines.append({"frame": timestamp_s, **frame_line(tracked)})
                if tracked.new_keyframe:
                    self._keyframes[tracked.new_keyframe.id] = tracked.new_keyframe
                T_world_odom = self._slam.correction.T_world_odom.get(tracked.segment)
                if T_world_odom is not None:
                    poses.append((timestamp_s, T_world_odom @ tracked.T_odom_cam))
        attempts = list(
            takewhile(
                lambda each: each.query_id in self._keyframes,
                self._slam.attempts[self._attempts :],
            )
        )
        self._attempts += len(attempts)
        lines += [{"loop": attempt_line(each)} for each in attempts]
        loops = [
            ledger_line(self._decision(each), self._header.min_similarity) for each in attempts
        ]
        self._append(JOURNAL, [json.dumps(line) for line in lines])
        self._append("trajectory.txt", tum_lines(_trajectory(poses))[1:])
        self._append("loops.jsonl", loops)

    def _decision(self, attempt: LoopAttempt) -> Decision:
        query, match = (self._keyframes[k] for k in (attempt.query_id, attempt.match_id))
        return Decision(attempt, query, match, None)

    def _append(self, name: str, lines: list[str]) -> None:
        descriptor = os.open(self._folder / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            data = "".join(f"{line}\n" for line in lines).encode()
            if os.write(descriptor, data) < len(data):  # in one go, or a line could be torn
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_journal(folder: Path) -> Journal:
    """Read back what a `JournalWriter` wrote, up to a line that is torn.

    Raises:
        SlamError: there is none, or it does not say what run it is of.
    """
    path = folder / JOURNAL
    try:
        check_file(path, _MOST_BYTES)
        file = path.open("rb")
    except (LoopcloseError, OSError) as error:
        raise SlamError(f"there is nothing unfinished to read: {cause_of(error)}") from error
    with file:  # line by line: all of hours would not fit into memory
        try:
            journal = Journal(header_of(json.loads(next(file, b""))))
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise SlamError(f"the journal does not say what run it is of: {path}") from error
        image = blank_preview(journal.header.camera)
        for line in file:
            try:
                _take(json.loads(line), journal, image)
            except (ValueError, TypeError, KeyError, IndexError, RecursionError):
                break
    return journal


def told_of(header: Header) -> dict[str, Any]:
    """Return what a journal tells of a run, for JSON."""
    certificate = header.certificate and header.certificate.model_dump(mode="json")
    return {**asdict(header), "certificate": certificate}


def header_of(told: dict[str, Any]) -> Header:
    """Return the header that a journal tells.

    Raises:
        KeyError, TypeError, ValueError: it is none.
    """
    camera = Camera(**{**told["camera"], "distortion": tuple(told["camera"]["distortion"])})
    certificate = told.get("certificate") and Certificate.model_validate(told["certificate"])
    warnings = tuple(told["warnings"])
    return Header(**{**told, "camera": camera, "warnings": warnings, "certificate": certificate})


def blank_preview(camera: Camera) -> Frame:
    """Return what stands for the image of every keyframe."""
    shape = (camera.height, camera.width)
    return preview(Frame(0.0, np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32)))


def _take(line: Line, journal: Journal, image: Frame) -> None:
    if "session" in line:
        journal.session_starts.add(len(journal.frames))
    elif "lost" in line:
        journal.frames.append((float(line["lost"]), None))
    elif "frame" in line:
        journal.frames.append((float(line["frame"]), frame_of(line, image)))
    else:
        attempt = attempt_of(line["loop"])
        journal.attempts.setdefault(attempt.query_id, []).append(attempt)


def _trajectory(poses: list[tuple[float, FloatArray]]) -> Trajectory:
    stamps_s = np.array([timestamp_s for timestamp_s, _ in poses])
    return Trajectory(stamps_s, np.array([T for _, T in poses]).reshape(-1, 4, 4))

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

from placerec.errors import LoopcloseError
from placerec.files import read_bytes
from slam.evaluation.trajectory import tum_lines
from slam.output.claimed_folder import JOURNAL
from slam.output.decision import Decision
from slam.output.ledger import ledger_line
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame, preview
from slam.types import (
    Camera,
    Features,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    SlamError,
    Trajectory,
    Verification,
)

_EVERY_S = 2.0
_MOST_BYTES = 1 << 32  # of a journal: a run of many hours
_UPPER = np.triu_indices(6)
_Line = dict[str, Any]


@dataclass(frozen=True)
class Header:
    """What a run is of.

    Attributes:
        title, command: as `write_run` takes them.
        camera: the camera.
        min_similarity: from which its loop candidates are verified.
        odometry: file of the poses from elsewhere, None without.
        warnings: what is to be said of the recordings.
    """

    title: str
    command: str
    camera: Camera
    min_similarity: float
    odometry: str | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Journal:
    """What a run has done, as read back.

    Attributes:
        header: what the run is of.
        frames: in the order of time, with None for one that was not placed. Keyframes have neither
            features nor images.
        session_starts: positions in `frames` at which a session begins.
        attempts: loop candidates by the id of the later keyframe, in the order they were looked at;
            without the pixels of their matches, and with the points of accepted loops alone.
    """

    header: Header
    frames: list[tuple[float, TrackedFrame | None]] = field(default_factory=list)
    session_starts: set[int] = field(default_factory=set)
    attempts: dict[int, list[LoopAttempt]] = field(default_factory=dict)


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
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._write_at_times, daemon=True, name="journal")

    def __enter__(self) -> Self:
        """Begin the files."""
        try:
            self._append(JOURNAL, [json.dumps(asdict(self._header))])
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

    def add(self, timestamp_s: float, tracked: TrackedFrame | Rejection) -> None:
        """Add what became of a frame."""
        self._news.append((timestamp_s, tracked))

    def _write_at_times(self) -> None:
        try:
            while not self._is_over.wait(_EVERY_S):
                self._write()
            self._write()
        except Exception as error:  # the run is worth more than its journal
            self.failure = error

    def _write(self) -> None:
        lines: list[_Line] = []
        poses: list[tuple[float, FloatArray]] = []
        while self._news:
            timestamp_s, tracked = self._news.popleft()
            if tracked is None:
                lines.append({"session": len(lines)})
            elif isinstance(tracked, Rejection):
                lines.append({"lost": timestamp_s})
            else:
                lines.append({"frame": timestamp_s, **_of_frame(tracked)})
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
        lines += [{"loop": _of_attempt(each)} for each in attempts]
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
        first, *lines = read_bytes(path, _MOST_BYTES).split(b"\n")
        header = json.loads(first)
        camera = Camera(**{**header["camera"], "distortion": tuple(header["camera"]["distortion"])})
        header = {**header, "camera": camera, "warnings": tuple(header["warnings"])}
        journal = Journal(Header(**header))
    except LoopcloseError as error:
        raise SlamError(f"there is nothing unfinished to read: {error}") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise SlamError(f"the journal does not say what run it is of: {path}") from error
    shape = (camera.height, camera.width)
    blank = Frame(0.0, np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32))
    image = preview(blank)
    for line in lines:
        try:
            _take(json.loads(line), journal, image)
        except (ValueError, TypeError, KeyError, IndexError, RecursionError):
            break
    return journal


def _take(line: _Line, journal: Journal, image: Frame) -> None:
    if "session" in line:
        journal.session_starts.add(len(journal.frames))
    elif "lost" in line:
        journal.frames.append((float(line["lost"]), None))
    elif "frame" in line:
        journal.frames.append((float(line["frame"]), _to_frame(line, image)))
    else:
        attempt = _to_attempt(line["loop"])
        journal.attempts.setdefault(attempt.query_id, []).append(attempt)


def _trajectory(poses: list[tuple[float, FloatArray]]) -> Trajectory:
    stamps_s = np.array([timestamp_s for timestamp_s, _ in poses])
    return Trajectory(stamps_s, np.array([T for _, T in poses]).reshape(-1, 4, 4))


def _numbers(T: FloatArray) -> list[float]:
    numbers: list[float] = T[:3].ravel().tolist()
    return numbers


def _matrix(numbers: list[float]) -> FloatArray:
    return np.vstack([np.reshape(numbers, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def _of_motion(motion: RelativePose) -> list[list[float]]:
    return [_numbers(motion.T_ref_query), motion.information[_UPPER].tolist()]


def _to_motion(numbers: list[list[float]]) -> RelativePose:
    information = np.zeros((6, 6))
    information[_UPPER] = numbers[1]
    information.T[_UPPER] = numbers[1]
    return RelativePose(_matrix(numbers[0]), information)


def _of_frame(tracked: TrackedFrame) -> _Line:
    line: _Line = {
        "against": tracked.keyframe_id,
        "segment": tracked.segment,
        "T_kf_cam": _numbers(tracked.T_kf_cam),
        "T_odom_cam": _numbers(tracked.T_odom_cam),
    }
    if keyframe := tracked.new_keyframe:
        links = [[each.ref_id, each.query_id, *_of_motion(each.motion)] for each in tracked.links]
        line |= {
            "keyframe": [keyframe.timestamp_s, _numbers(keyframe.T_odom_cam)],
            "turning_rad_s": keyframe.turning_rad_s,
            "links": links,
            "moved": [[k, _numbers(T)] for k, T in tracked.moved.items()],
        }
    return line


def _to_frame(line: _Line, image: Frame) -> TrackedFrame:
    keyframe_id, segment = int(line["against"]), int(line["segment"])
    T_kf_cam, T_odom_cam = _matrix(line["T_kf_cam"]), _matrix(line["T_odom_cam"])
    if "keyframe" not in line:
        return TrackedFrame(keyframe_id, T_kf_cam, T_odom_cam, segment)
    timestamp_s, T = line["keyframe"]
    none = np.zeros((0, 2))
    features = Features(
        none,
        none,
        np.zeros(0, np.int64),
        np.zeros((0, 32), np.uint8),
        np.zeros(0),
        np.zeros((0, 3)),
    )
    keyframe = Keyframe(
        keyframe_id,
        float(timestamp_s),
        _matrix(T),
        features,
        image,
        float(line["turning_rad_s"]),
        segment,
    )
    links = tuple(Link(ref, query, _to_motion(motion)) for ref, query, *motion in line["links"])
    moved = {k: _matrix(T) for k, T in line["moved"]}
    return TrackedFrame(keyframe_id, T_kf_cam, T_odom_cam, segment, keyframe, links, moved)


def _of_attempt(attempt: LoopAttempt) -> _Line:
    line: _Line = {
        "query": attempt.query_id,
        "match": attempt.match_id,
        "similarity": attempt.similarity,
    }
    if rejection := attempt.rejection:
        line["rejection"] = [rejection.reason.name, rejection.measured, rejection.needed]
    if attempt.motion:
        line["motion"] = _of_motion(attempt.motion)
    if seen := attempt.verification:
        line["is_inlier"] = "".join(str(int(each)) for each in seen.inlier_mask)
        if not rejection:
            line["points_m"] = np.round(seen.points_ref_m[seen.inlier_mask], 6).tolist()
    return {key: _plain(value) for key, value in line.items()}


def _plain(value: Any) -> Any:
    """Return numbers of numpy as Python's, which alone can be written."""
    return (
        [_plain(each) for each in value]
        if isinstance(value, list)
        else (value.item() if isinstance(value, np.generic) else value)
    )


def _to_attempt(line: _Line) -> LoopAttempt:
    motion = _to_motion(line["motion"]) if "motion" in line else None
    rejection = None
    if "rejection" in line:
        reason, measured, needed = line["rejection"]
        rejection = Rejection(RejectionReason[reason], measured, needed)
    outcome = rejection or motion
    if outcome is None:
        raise KeyError("rejection")
    verification = None
    if "is_inlier" in line:
        mask = np.array([each == "1" for each in line["is_inlier"]], bool)
        points_m = np.zeros((len(mask), 3))
        if "points_m" in line:
            points_m[mask] = line["points_m"]
        verification = Verification(motion or outcome, np.zeros((len(mask), 4)), mask, points_m)
    return LoopAttempt(
        int(line["query"]), int(line["match"]), float(line["similarity"]), verification, outcome
    )

# SPDX-License-Identifier: Apache-2.0
"""The folder that a run writes to: nobody else's, and never with files of two runs."""

import fcntl
import os
import re
import shutil
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from placerec.errors import LoopcloseError
from placerec.files import check_file, read_json
from slam.datasets.formats import find_format
from slam.types import SlamError

OUTPUTS = (
    "trajectory.txt",
    "odometry.txt",
    "keyframes.txt",
    "corrected_odometry.txt",
    "corrected_odometry.csv",
    "map_odom.txt",
    "groundtruth.txt",
    "measurements.npz",
    "loops.jsonl",
    "pose_graph.g2o",
    "settings.toml",
    "mesh_before.ply",
    "mesh_after.ply",
    "summary.json",
    "report.html",
    "map.ply",
)
"""Names of all files that a run may leave, in the order in which they are written."""

UNFINISHED = "unfinished"
"""Where a run keeps what it has done so far, and then what it is writing."""

JOURNAL = "journal.jsonl"
"""What in `unfinished` tells that it is a run's; a run may add to it."""

# Complete, with the files of an earlier run still to be removed; and on their way to their place.
_WRITTEN, _MOVING = ".written", ".moving"
_SETTINGS, _SUMMARY = "settings.toml", "summary.json"
_LEFT_OF_A_FILE = re.compile(rf"\.({'|'.join(map(re.escape, OUTPUTS))})\.\d+\.part")
_LEFT_OF_THE_DEMO = ".rendering-*"


class ClaimedFolder:
    """A folder that one run has for itself, as a context.

    Everything is written into `unfinished` and put in place by `complete`, which first removes all
    files of an earlier run: so there are never files of two. Whoever is killed on the way leaves
    what the next one to claim the folder completes.

    Attributes:
        path: the folder.
        unfinished: the folder in it where a run keeps what is not complete.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.unfinished = path / UNFINISHED
        self._lock: int | None = None
        self._made: list[Path] = []

    def __enter__(self) -> Self:
        """Make the folder where there is none, and claim it.

        Raises:
            SlamError: it cannot be made or written to, it holds a recording, or another run is
                writing to it.
        """
        try:
            if self.path.is_dir() and self._is_recording():
                raise SlamError(
                    "the outputs would replace files of the recording in this folder; choose"
                    f" another with --out: {self.path}"
                )
            missing = [each for each in (self.path, *self.path.parents) if not each.exists()]
            self.path.mkdir(parents=True, exist_ok=True)
            self._made = missing
            what = "the output folder; wait until it is over, or choose another folder with --out"
            self._lock = locked(self.path, what)
            probe = self.path / f".{os.getpid()}.probe"
            probe.touch()
            probe.unlink()
            self._tidy()
        except OSError as error:
            self._let_go()
            raise SlamError(
                "cannot write to the output folder (choose another with --out):"
                f" {error.strerror}: {self.path}"
            ) from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let others have the folder, which goes if nothing came into it."""
        self._let_go()

    @property
    def is_complete(self) -> bool:
        """Whether there is a run, and nothing unfinished."""
        return bool(self._owned()) and not (self.unfinished / JOURNAL).exists()

    def refuse_foreign(self, names: Collection[str]) -> None:
        """Refuse to write files where there are others of that name that no run of ours left.

        Raises:
            SlamError: there is one.
        """
        owned = self._owned()
        taken = [name for name in names if name not in owned and os.path.lexists(self.path / name)]
        if taken:
            raise SlamError(
                f"the output folder holds a {taken[0]} that is not known to be of an earlier run;"
                f" move it away, or choose another folder with --out: {self.path}"
            )

    def start(self) -> bool:
        """Make `unfinished` anew; return whether a run that was killed had left something there.

        Raises:
            SlamError: it cannot be made, or there is one of somebody else's.
        """
        had_left = (self.unfinished / JOURNAL).exists()
        try:
            if not had_left and self.unfinished.is_dir() and any(self.unfinished.iterdir()):
                raise SlamError(
                    f"there is a folder of that name which no run has left; move it away, or"
                    f" choose another folder with --out: {self.unfinished}"
                )
            self.discard()
            self.unfinished.mkdir(parents=True, exist_ok=True)
            (self.unfinished / JOURNAL).touch()
        except OSError as error:
            raise SlamError(
                f"cannot write to the output folder: {error.strerror}: {self.path}"
            ) from error
        return had_left

    def discard(self) -> None:
        """Forget what is unfinished."""
        with suppress(OSError):  # its mark goes last, so that whoever is killed here can be told
            for each in self.unfinished.iterdir():
                if each.name != JOURNAL:
                    each.unlink()
        shutil.rmtree(self.unfinished, ignore_errors=True)

    def complete(self) -> None:
        """Put the files of `unfinished` in the place of those of an earlier run.

        Raises:
            SlamError: somebody's file is in the way, or they cannot be moved; they stay where they
                are.
        """
        try:
            self.refuse_foreign([each.name for each in self.unfinished.iterdir()])
            sync(self.unfinished)
            self.unfinished.replace(self.path / _WRITTEN)
            self._tidy()
        except OSError as error:
            raise SlamError(
                f"cannot put the outputs in place: {error.strerror}; the next run, or --finish,"
                f" completes them: {self.path}"
            ) from error

    def _is_recording(self) -> bool:
        return (self.path / "rgb.txt").exists() or find_format(self.path) is not None

    def _tidy(self) -> None:
        """Complete what was written whole, and remove what a killed run left of single files."""
        written, moving = self.path / _WRITTEN, self.path / _MOVING
        if written.exists():
            for name in _telling_last(self._owned()):
                (self.path / name).unlink(missing_ok=True)
            sync(self.path)
            written.replace(moving)
        if moving.exists():
            for name in _telling_last(OUTPUTS):
                if (moving / name).exists():
                    (moving / name).replace(self.path / name)
            sync(self.path)
            shutil.rmtree(moving)
        for each in self.path.glob(".*.part"):
            if _LEFT_OF_A_FILE.fullmatch(each.name):
                each.unlink(missing_ok=True)
        for each in self.path.glob(_LEFT_OF_THE_DEMO):
            shutil.rmtree(each, ignore_errors=True)

    def _owned(self) -> set[str]:
        """Return the names of the outputs that an earlier run has left, by what it tells."""
        try:
            summary = read_json(self.path / _SUMMARY)
            if isinstance(summary, dict) and "frames_tracked" in summary:
                return {_SUMMARY, *(set(OUTPUTS) & set(summary.get("files", OUTPUTS)))}
        except (LoopcloseError, TypeError):
            pass
        try:
            check_file(self.path / _SETTINGS)
            with (self.path / _SETTINGS).open(encoding="utf-8", errors="replace") as settings:
                is_ours = settings.readline(10_000).endswith("--config settings.toml\n")
        except (LoopcloseError, OSError):
            is_ours = False
        return set(OUTPUTS) if is_ours else set()

    def _let_go(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        for each in self._made:
            try:
                each.rmdir()
            except OSError:  # something came into it
                break
        self._made = []


def locked(folder: Path, what: str) -> int:
    """Return a descriptor that locks a folder until it is closed, or the process is no more.

    Raises:
        SlamError: another process has it: says what that writes into, and what to do.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise SlamError(f"another run is writing into {what}: {folder}") from error
    except OSError:
        pass  # a file system without locks; most have them
    return descriptor


def _telling_last(names: Iterable[str]) -> list[str]:
    """Return names in an order in which those come last that tell whose the others are."""
    return sorted(names, key=lambda name: (name == _SUMMARY, name == _SETTINGS, name))


def sync(folder: Path) -> None:
    """Let a folder's entries outlast a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    with suppress(OSError):  # not every file system can
        os.fsync(descriptor)
    os.close(descriptor)

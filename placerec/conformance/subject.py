# SPDX-License-Identifier: Apache-2.0
"""The recognizer that is checked, alone and in a fresh process, and what a check finds."""

import os
import subprocess
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import COSINES, Comparer
from placerec.conformance.made_images import GAINS, SHIFT_PX, Image, places, relit, unlike
from placerec.errors import RecognizerError, cause_of
from placerec.recognizer import PlaceRecognizer, load

_ROUNDS = 4
_STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class FreshRun:
    """What a recognizer did in a fresh process.

    Attributes:
        embeddings: of the places, (N, ...) as it returned them.
        own_mb: memory that it took to load and to work, NaN where the system does not tell.
        kept_mb: memory that every further image took for good, NaN likewise.
    """

    embeddings: NDArray[Any]
    own_mb: float
    kept_mb: float


def run_in_fresh_process(name: str) -> FreshRun:
    """Return what a recognizer does in another Python, with another order of sets.

    Raises:
        RecognizerError: it cannot be loaded there, or fails.
    """
    with TemporaryDirectory() as folder:
        out = Path(folder) / "run.npz"
        code = "from placerec.conformance.subject import main; main()"
        paths = os.pathsep.join(path for path in sys.path if path)
        done = subprocess.run(
            [sys.executable, "-c", code, name, str(out)],
            env=os.environ | {"PYTHONPATH": paths, "PYTHONHASHSEED": "random"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            check=False,
        )
        if done.returncode:
            said = done.stderr.strip().splitlines()
            raise RecognizerError(said[-1] if said else f"it ended with code {done.returncode}")
        with np.load(out) as run:
            return FreshRun(run["embeddings"], float(run["own_mb"]), float(run["kept_mb"]))


def main() -> None:
    """Run the recognizer that the command line names, and leave what it did in a file."""
    name, out = sys.argv[1:]
    images = places()
    before_mb = _status_mb("VmRSS")
    try:
        recognizer = load(name)
    except RecognizerError as error:
        sys.exit(str(error))  # the last line of stderr is what the other process looks at
    embeddings = [np.array(recognizer.embed(image.copy())) for image in images]
    settled_mb = _status_mb("VmRSS")
    for image in images * _ROUNDS:
        recognizer.embed(image.copy())
    kept_mb = (_status_mb("VmRSS") - settled_mb) / (len(images) * _ROUNDS)
    own_mb = _status_mb("VmHWM") - before_mb
    np.savez(out, embeddings=np.stack(embeddings), own_mb=own_mb, kept_mb=kept_mb)


def _status_mb(key: str) -> float:
    """Return a figure of Linux about this process: memory now (VmRSS) or at most (VmHWM)."""
    if not _STATUS.exists():
        return float("nan")
    rows = dict(line.split(":", 1) for line in _STATUS.read_text().splitlines())
    return int(rows[key].split()[0]) / 1024


def program_settings() -> dict[str, object]:
    """Return the settings that all of a program shares, by what people call them."""
    settings: dict[str, object] = {
        "the current folder": Path.cwd(),
        "numpy's error settings": np.geterr(),
    }
    torch: Any = sys.modules.get("torch")  # whoever has not loaded it has not set it
    if torch:
        settings["torch's number of threads"] = torch.get_num_threads()
        settings["torch's gradient mode"] = torch.is_grad_enabled()
        settings["torch's default type"] = torch.get_default_dtype()
    return settings


class NamelessError(Exception):
    """Another recognizer of the kind cannot be made, for it was handed over without a name."""


class Subject:
    """A recognizer that is checked.

    Attributes:
        recognizer: the recognizer.
        compares: whether it compares its embeddings itself; if not, their cosine does.
        comparer: what compares its embeddings, unchecked.
        settings_before: the program's, as they were before it saw an image.
    """

    def __init__(self, recognizer: PlaceRecognizer, name: str | None) -> None:
        """Take a recognizer, and what `load` makes another by; None where nobody knows."""
        self.settings_before = program_settings()
        self.recognizer = recognizer
        self._name = name
        self.compares = callable(getattr(recognizer, "compare", None))
        self.comparer = cast(Comparer, recognizer) if self.compares else COSINES

    def embed(self, image: Image) -> NDArray[Any]:
        """Return as an array what the recognizer makes of a copy of an image, or let it raise."""
        # A copy of the answer too: what becomes of the array that was returned has its own check.
        return np.array(self.recognizer.embed(image.copy()))

    @cached_property
    def embeddings(self) -> list[NDArray[Any]]:
        """What the recognizer makes of each of the places."""
        return [self.embed(image) for image in places()]

    @cached_property
    def relit(self) -> list[NDArray[Any]]:
        """What it makes of all places in less light and in more, each (PLACES, *S)."""
        return [np.stack([self.embed(image) for image in relit(gain)]) for gain in GAINS]

    @cached_property
    def shifted(self) -> list[NDArray[Any]]:
        """What it makes of all places with the camera turned a little, (PLACES, *S) alone."""
        return [np.stack([self.embed(image) for image in places(SHIFT_PX)])]

    @cached_property
    def unlike(self) -> NDArray[Any]:
        """What it makes of pictures that have nothing in common, and of the places, (N, *S)."""
        return np.stack([*(self.embed(image) for image in unlike()), *self.embeddings])

    @cached_property
    def fresh_run(self) -> FreshRun:
        """What one of its kind does in a Python of its own; a RecognizerError if it fails there."""
        return run_in_fresh_process(self.name)

    @property
    def name(self) -> str:
        """What `load` makes another one by; a NamelessError where nobody knows."""
        if self._name is None:
            raise NamelessError("there is no name to make another one by")
        return self._name

    def explain(self, error: Exception) -> str:
        """Return an exception as one line that ends in where the recognizer raised it."""
        lines = [
            f" ({Path(frame.f_code.co_filename).name}:{line})"
            for frame, line in traceback.walk_tb(error.__traceback__)
            if self.owns(frame)
        ]
        return cause_of(error) + "".join(lines[-1:])

    def owns(self, frame: FrameType) -> bool:
        """Return whether the package that the recognizer comes from is running there."""
        running = str(frame.f_globals.get("__name__", ""))
        return running.split(".")[0] == type(self.recognizer).__module__.split(".")[0]


class Verdict(StrEnum):
    """Whether a recognizer does what a check asks for; the values are what people read."""

    PASSED = "ok"
    DOUBTFUL = "warn"
    FAILED = "FAIL"
    NOT_TRIED = "--"


Outcome = tuple[bool | Verdict, str]
"""Whether a check passed, or a verdict between, and in one line the value that says so."""


@dataclass(frozen=True)
class Check:
    """One thing that a recognizer must do.

    Attributes:
        name: what it must do, in a few words.
        run: tries it out; where that raises, the check has failed.
        remedy: what the recognizer's author can do where it fails, in one line.
        needs: earlier checks without which this one would say nothing new.
    """

    name: str
    run: Callable[[Subject], Outcome]
    remedy: str
    needs: tuple["Check", ...] = ()


def as_check(
    name: str, remedy: str, *needs: Check
) -> Callable[[Callable[[Subject], Outcome]], Check]:
    """Make a check of the function that follows."""
    return lambda run: Check(name, run, remedy, needs)


@dataclass(frozen=True)
class Finding:
    """A check that was made, or not tried, and its outcome."""

    check: Check
    verdict: Verdict
    measured: str

    @property
    def failed(self) -> bool:
        """Whether the recognizer does not do what it must."""
        return self.verdict is Verdict.FAILED

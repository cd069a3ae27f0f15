# SPDX-License-Identifier: Apache-2.0
"""A recognizer at work in a Python of its own."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.conformance.pictures import places
from placerec.recognizer import RecognizerError, load

ROUNDS = 4
STATUS = Path("/proc/self/status")
CODE = "from placerec.conformance.fresh_process import main; main()"


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
        paths = os.pathsep.join(path for path in sys.path if path)
        done = subprocess.run(
            [sys.executable, "-c", CODE, name, str(out)],
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
            own_mb, kept_mb = (float(value) for value in run["memory_mb"])
            return FreshRun(run["embeddings"], own_mb, kept_mb)


def main() -> None:
    """Run the recognizer that the command line names, and leave what it did in a file."""
    name, out = sys.argv[1:]
    images = places()
    before_mb = _status_mb("VmRSS")
    try:
        recognizer = load(name)
    except RecognizerError as error:
        sys.exit(str(error))  # the last line of stderr is what the other process looks at
    embeddings = [np.asarray(recognizer.embed(image.copy())) for image in images]
    settled_mb = _status_mb("VmRSS")
    for image in images * ROUNDS:
        recognizer.embed(image.copy())
    kept_mb = (_status_mb("VmRSS") - settled_mb) / (len(images) * ROUNDS)
    memory_mb = (_status_mb("VmHWM") - before_mb, kept_mb)
    np.savez(out, embeddings=np.stack(embeddings), memory_mb=memory_mb)


def _status_mb(key: str) -> float:
    """Return a figure of Linux about this process: memory now (VmRSS) or at most (VmHWM)."""
    if not STATUS.exists():
        return float("nan")
    rows = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
    return int(rows[key].split()[0]) / 1024

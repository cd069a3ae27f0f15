# SPDX-License-Identifier: Apache-2.0
"""The demo sequence, rendered by a process of its own: what Open3D takes is given back with it."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from placerec.errors import cause_of, terminations_interrupt
from slam.types import SlamError


def render_apart(folder: Path, progress: Callable[[int, int], None], **asked: float) -> None:
    """Do what `render_sequence` does, to which all else that is asked for is handed on.

    Raises:
        SlamError: the folder is not empty or cannot be written, or the process was ended.
    """
    code = "from slam.demo.separate_process import main; main()"
    paths = os.pathsep.join(path for path in sys.path if path)
    rendering = subprocess.Popen(
        [sys.executable, "-c", code, str(folder), json.dumps(asked)],
        env=os.environ | {"PYTHONPATH": paths, "PYTHONIOENCODING": "utf-8:backslashreplace"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        process_group=0,  # a terminal's Ctrl-C is passed on once, below
    )
    with rendering:
        assert rendering.stdout is not None
        try:
            said = _follow(rendering.stdout, progress)
            code_or_signal = rendering.wait()
        except BaseException:
            rendering.terminate()
            rendering.wait()  # it tidies up
            raise
    if code_or_signal < 0:
        name = signal.Signals(-code_or_signal).name
        raise SlamError(f"the process that renders the demo was ended by {name}: {folder}")
    if code_or_signal:
        raise SlamError(said)


def _follow(lines: Iterable[str], progress: Callable[[int, int], None]) -> str:
    """Pass on how far it is; return the last line that says something else."""
    said = "rendering the demo failed"
    for line in lines:
        numbers = line.split()
        if len(numbers) == 2 and all(each.isdecimal() for each in numbers):
            progress(int(numbers[0]), int(numbers[1]))
        else:
            said = line.strip() or said
    return said


def main() -> None:
    """Render into the folder that the command line names, and print how far it is."""
    folder, asked = sys.argv[1:]
    with terminations_interrupt():
        try:
            from slam.demo.recording import render_sequence

            render_sequence(Path(folder), progress=_tell, **json.loads(asked))
        except KeyboardInterrupt:
            sys.exit("interrupted")
        except Exception as error:
            sys.exit(cause_of(error))  # the last line is what the other process looks at


def _tell(done: int, total: int) -> None:
    sys.stdout.write(f"{done} {total}\n")
    sys.stdout.flush()

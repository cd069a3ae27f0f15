# SPDX-License-Identifier: Apache-2.0
"""Where the time of a run of `run_slam` goes: processor seconds per thread and stage.

    python -m benchmarks.profile SEQUENCE [--out FOLDER]

The run is one of `run_slam`, in this process, with start-up and outputs. Prints a Markdown table
and writes it into the folder; and, where py-spy is installed, a flame graph of a second run, in
which a box is as wide as the time that a function was on the stack of some thread.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from slam.__main__ import main as run_slam
from slam.stage_clock import StageClock

SAMPLES_PER_S = 200


class Profile:
    """Adds up what each thread works in each stage, which `StageClock` times by the wall.

    Attributes:
        seconds: processor seconds by thread and stage.
        total_s: those of the whole run, of all threads, also of the libraries' own.
    """

    def __init__(self) -> None:
        self.seconds: Counter[tuple[str, str]] = Counter()
        self.total_s = 0.0

    def run(self, arguments: list[str]) -> int:
        """Do what `run_slam` does with these arguments and return its exit code."""
        timed = StageClock.stage

        @contextmanager
        def stage(clock: StageClock, name: str) -> Iterator[None]:
            start_s = time.thread_time()
            try:
                with timed(clock, name):
                    yield
            finally:
                thread = threading.current_thread().name.rstrip("_0123456789")
                self.seconds[thread, name] += time.thread_time() - start_s

        start_s = time.process_time()
        with patch.object(StageClock, "stage", stage):
            code = run_slam(arguments)
        self.total_s = time.process_time() - start_s
        return code

    def table(self) -> str:
        """Return the Markdown table, the most work first; the rest is all that no stage has."""
        rows = [(*key, seconds) for key, seconds in self.seconds.most_common()]
        rest = self.total_s - sum(self.seconds.values())
        rows.append(("", "start-up, outputs, decoding ahead, adjusting beside, the rest", rest))
        lines = ["| thread | stage | processor s | share |", "|---|---|---|---|"]
        lines += [
            f"| {thread} | {stage} | {seconds:.2f} | {seconds / self.total_s:.0%} |"
            for thread, stage, seconds in rows
        ]
        return "\n".join([*lines, f"| | all | {self.total_s:.2f} | 100% |"]) + "\n"


def flame_graph(arguments: list[str], file: Path) -> bool:
    """Sample another run into an SVG file; return whether that could be done."""
    sampler = shutil.which("py-spy")
    if sampler is None:
        print("no flame graph: pip install py-spy", file=sys.stderr)
        return False
    how = ["--rate", str(SAMPLES_PER_S), "--threads", "--output", str(file)]
    ran = subprocess.run(
        [sampler, "record", *how, "--", sys.executable, "-m", "slam", *arguments], check=False
    )
    return ran.returncode == 0


def main(arguments: list[str] | None = None) -> int:
    """Profile, print, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("sequence", metavar="SEQUENCE", help="as for run_slam")
    parser.add_argument("--out", type=Path, default=Path("runs/profile"), metavar="FOLDER")
    parsed = parser.parse_args(arguments)
    parsed.out.mkdir(parents=True, exist_ok=True)
    profile = Profile()
    with tempfile.TemporaryDirectory() as folder:
        code = profile.run([parsed.sequence, "--out", f"{folder}/once"])
        if code:
            return code
        print(profile.table(), end="")
        (parsed.out / "profile.md").write_text(profile.table())
        flame_graph([parsed.sequence, "--out", f"{folder}/again"], parsed.out / "flame.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())

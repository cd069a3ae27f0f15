# SPDX-License-Identifier: Apache-2.0
"""Where the time of a run of `run_slam` goes: processor seconds per stage and thread.

    python -m benchmarks.profile SEQUENCE [--out FOLDER]

The run is one of `run_slam`, in this process, with start-up and outputs. Prints Markdown tables
and writes them into the folder; and, where py-spy is installed, a flame graph of a second run, in
which a box is as wide as the time that a function was on the stack of some thread. Linux only: it
asks /proc what threads work.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar
from unittest.mock import patch

from slam.__main__ import main as run_slam
from slam.loops.stage_clock import StageClock

SAMPLES_PER_S = 200
_Key = TypeVar("_Key")
_LOOK_EVERY_S = 0.05
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Profile:
    """Adds up what each thread works, and in which stage, which `StageClock` times by the wall.

    Attributes:
        stages: processor seconds by thread and stage.
        threads: processor seconds by thread; threads of libraries have no name here.
        total_s: those of the whole run.
    """

    def __init__(self) -> None:
        self.stages: dict[tuple[str, str], float] = defaultdict(float)
        self.threads: dict[str, float] = {}
        self.total_s = 0.0
        self._worked: dict[tuple[int, str], float] = {}  # by thread number and name

    def run(self, arguments: list[str]) -> int:
        """Do what `run_slam` does with these arguments and return its exit code."""
        timed, main, marks = StageClock.stage, threading.main_thread(), [time.thread_time()]

        @contextmanager
        def stage(clock: StageClock, name: str) -> Iterator[None]:
            thread, start_s = threading.current_thread(), time.thread_time()
            if thread is main and len(marks) == 1:
                self.stages[main.name, "start-up"] = start_s - marks[0]
            try:
                with timed(clock, name):
                    yield
            finally:
                end_s = time.thread_time()
                self.stages[_name(thread), name] += end_s - start_s
                if thread is main:
                    marks[1:] = [end_s]

        start_s, is_over = time.process_time(), threading.Event()
        watcher = threading.Thread(target=self._watch, args=(is_over,), daemon=True)
        watcher.start()
        with patch.object(StageClock, "stage", stage):
            code = run_slam(arguments)
        self.total_s = time.process_time() - start_s
        self.stages[main.name, "outputs"] = time.thread_time() - marks[-1]
        is_over.set()
        watcher.join()
        self.threads = _most_first(self._by_thread())
        return code

    def _watch(self, is_over: threading.Event) -> None:
        before = self._look()
        self._worked = {key: -seconds for key, seconds in before.items()}
        seen = dict(before)
        while not is_over.wait(_LOOK_EVERY_S):
            seen |= self._look()
        self._worked = {key: s + self._worked.get(key, 0.0) for key, s in seen.items()}

    def _look(self) -> dict[tuple[int, str], float]:
        """Return what the threads of this process worked since they began."""
        names = {each.native_id: _name(each) for each in threading.enumerate()}
        worked = {}
        for folder in Path("/proc/self/task").iterdir():
            with suppress(OSError):  # one that has just ended
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
                ticks = int(fields[11]) + int(fields[12])  # in its own code, and in the system's
                number = int(folder.name)
                worked[number, names.get(number, "(of a library)")] = ticks / _TICKS_PER_S
        return worked

    def _by_thread(self) -> dict[str, float]:
        threads: dict[str, float] = defaultdict(float)
        for (_, name), seconds in self._worked.items():
            threads[name] += seconds
        return threads

    def table(self) -> str:
        """Return two Markdown tables: stages and threads, those with the most work first."""
        by_stage = _most_first(self.stages).items()
        stages = [(f"{thread}: {stage}", s) for (thread, stage), s in by_stage]
        parts = []
        for title, rows in (("stage", stages), ("thread", list(self.threads.items()))):
            parts += [f"| {title} | processor s | share of all |", "|---|---|---|"]
            parts += [f"| {name} | {s:.2f} | {s / self.total_s:.0%} |" for name, s in rows]
            parts += [f"| the whole run | {self.total_s:.2f} | 100% |", ""]
        return "\n".join(parts)


def _most_first(seconds: dict[_Key, float]) -> dict[_Key, float]:
    return dict(sorted(seconds.items(), key=lambda each: -each[1]))


def _name(thread: threading.Thread) -> str:
    return thread.name.rstrip("_0123456789")


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
        print(profile.table())
        (parsed.out / "profile.md").write_text(profile.table())
        flame_graph([parsed.sequence, "--out", f"{folder}/again"], parsed.out / "flame.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())

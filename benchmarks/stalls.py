# SPDX-License-Identifier: Apache-2.0
"""How long one frame keeps `Slam.process` busy: prints Markdown tables of all calls of a run.

    python -m benchmarks.stalls SEQUENCE [--runs 1] [--recognizer NAME] [--out FILE]

The pipeline runs as in `run_slam`: images are decoded ahead in threads that a call competes with
but does not count. Of several runs, each in this process, the worst of every figure is shown.

Start-up is counted: nothing is warmed up. The first run's first call has a row of its own, too.
"""

import argparse
import gc
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.sequences import find, machine
from placerec.recognizer import PlaceRecognizer, load
from slam import Config, Slam, TrackedFrame, open_sequence
from slam.commands.opening import DEFAULT_RECOGNIZER
from slam.datasets import Sequence
from slam.geometry.features import FeatureExtractor
from slam.geometry.keyframe_memory import KeyframeMemory
from slam.loops.back_end import BackEnd
from slam.mapping.local_map import LocalMap
from slam.tracking import odometry
from slam.tracking.odometry import RgbdOdometry
from slam.tracking.trails import Trails

# What a call is made of, and where; a part within a part counts as the outer one.
PARTS: dict[str, tuple[Any, str]] = {
    "features": (FeatureExtractor, "extract"),
    "adjustment": (RgbdOdometry, "settle"),
    "placing": (RgbdOdometry, "_follow"),
    "relocalization": (Trails, "relocalize"),
    "recognition": (Trails, "recognize"),
    "local map": (LocalMap, "insert"),
    "links": (odometry, "covisible_links"),
    "preview": (odometry, "preview"),
    "its compression": (KeyframeMemory, "keep_image"),
    "waiting for loops": (BackEnd, "insert"),
}
LONGEST = 5
LIMIT_MS = 100.0


@dataclass
class Call:
    """One call of `Slam.process`, milliseconds.

    Attributes:
        frame: the number of its frame.
        is_keyframe: whether the frame became one.
        ms: how long it took.
        cpu_ms: how long the thread computed; the rest is waiting for others.
        parts_ms: how long its parts took, garbage collection ("gc", wherever it falls) included.
    """

    frame: int
    is_keyframe: bool = False
    ms: float = 0.0
    cpu_ms: float = 0.0
    parts_ms: dict[str, float] = field(default_factory=lambda: defaultdict(float))


class Stopwatch:
    """Times the parts of the call that is under way, where they are entered by its thread."""

    def __init__(self) -> None:
        self.call = Call(-1)
        self._thread = threading.get_ident()
        self._is_inside = False
        self._gc_start_s = 0.0

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Time the parts until the block ends."""
        gc.callbacks.append(self._collected)
        try:
            with ExitStack() as stack:
                for part, (owner, name) in PARTS.items():
                    timed = self._timed(part, getattr(owner, name))
                    stack.enter_context(patch.object(owner, name, timed))
                yield
        finally:
            gc.callbacks.remove(self._collected)

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def timed(*arguments: Any, **options: Any) -> Any:
            if self._is_inside or threading.get_ident() != self._thread:
                return function(*arguments, **options)
            start_s, self._is_inside = time.perf_counter(), True
            try:
                return function(*arguments, **options)
            finally:
                self._is_inside = False
                self.call.parts_ms[part] += 1e3 * (time.perf_counter() - start_s)

        return timed

    def _collected(self, phase: str, _: dict[str, int]) -> None:
        if phase == "start":
            self._gc_start_s = time.perf_counter()
        else:
            self.call.parts_ms["gc"] += 1e3 * (time.perf_counter() - self._gc_start_s)


def calls_of_a_run(sequence: Sequence, recognizer: PlaceRecognizer) -> list[Call]:
    """Run the pipeline to its end and return its calls."""
    gc.collect()
    gc.freeze()  # as run_slam does
    stopwatch, calls = Stopwatch(), []
    slam = Slam(sequence.camera, recognizer)
    with stopwatch.attached():
        for i, frame in enumerate(sequence):
            call = stopwatch.call = Call(i)
            start_s, cpu_start_s = time.perf_counter(), time.thread_time()
            tracked = slam.process(frame)
            call.ms = 1e3 * (time.perf_counter() - start_s)
            call.cpu_ms = 1e3 * (time.thread_time() - cpu_start_s)
            call.is_keyframe = isinstance(tracked, TrackedFrame) and bool(tracked.new_keyframe)
            calls.append(call)
    slam.finish()
    return calls


GROUPS: dict[str, Callable[[Call], bool]] = {
    "all": lambda _: True,
    "the first": lambda call: call.frame == 0,
    "later keyframes": lambda call: call.is_keyframe and call.frame > 0,
    "other frames": lambda call: not call.is_keyframe and call.frame > 0,
}


def distribution(runs: list[list[Call]]) -> str:
    """Return a table: how long calls took, and how long they computed; the worst of the runs."""
    lines = [
        "| calls | number | median, ms | 95 % | 99 % | longest | over 100 ms |",
        "|---|---|---|---|---|---|---|",
    ]
    for title, belongs in GROUPS.items():
        chosen = [[call for call in run if belongs(call)] for run in runs]
        if all(chosen):
            lines.append(_row(title, [[call.ms for call in calls] for calls in chosen]))
            computing = [[call.cpu_ms for call in calls] for calls in chosen]
            lines.append(_row(f"{title}, computing", computing))
    return "\n".join(lines)


def _row(title: str, runs_ms: list[list[float]]) -> str:
    worst = np.max([np.percentile(each_ms, [50, 95, 99, 100]) for each_ms in runs_ms], axis=0)
    over = max(int(np.count_nonzero(np.array(each_ms) > LIMIT_MS)) for each_ms in runs_ms)
    figures = " | ".join(f"{ms:.1f}" for ms in worst)
    return f"| {title} | {len(runs_ms[0])} | {figures} | {over} |"


def longest(calls: list[Call], title: str) -> str:
    """Return a table: what the longest calls spent their time on."""
    chosen = sorted(calls, key=lambda call: -call.ms)[:LONGEST]
    parts = [*PARTS, "gc"]
    lines = [
        f"| {title} | ms | computing | " + " | ".join(parts) + " |",
        "|---" * (3 + len(parts)) + "|",
    ]
    for call in chosen:
        spent = " | ".join(f"{call.parts_ms[part]:.1f}" for part in parts)
        kind = " (keyframe)" if call.is_keyframe else ""
        lines.append(f"| {call.frame}{kind} | {call.ms:.1f} | {call.cpu_ms:.1f} | {spent} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print and write; return 1 where there is no such sequence."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("sequence", help="a benchmark name or a folder")
    parser.add_argument("--runs", type=int, default=1, help="runs, one after the other")
    parser.add_argument("--recognizer", default=DEFAULT_RECOGNIZER, help="as for run_slam")
    parser.add_argument("--out", type=Path, help="a file that the tables are written to as well")
    parsed = parser.parse_args(arguments)
    if parsed.runs < 1:
        parser.error(f"--runs {parsed.runs}: at least one is needed")
    path = find(parsed.sequence)
    if path is None:
        print(f"not on this machine: {parsed.sequence}", file=sys.stderr)
        return 1
    facts, recognizer = machine(), load(parsed.recognizer)
    sequence = open_sequence(Path(path), Config().input)
    runs = [calls_of_a_run(sequence, recognizer) for _ in range(parsed.runs)]
    together = [call for run in runs for call in run]
    ordinary = [call for call in together if not call.is_keyframe]
    tables = [
        distribution(runs),
        longest(together, "longest calls: frame"),
        longest(ordinary, "longest without a keyframe: frame"),
    ]
    caption = f"{Path(path).name}, recognizer {parsed.recognizer}; worst of {parsed.runs}; {facts}."
    text = "\n\n".join([*tables, caption]) + "\n"
    print(text, end="")
    if parsed.out:
        parsed.out.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())

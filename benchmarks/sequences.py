# SPDX-License-Identifier: Apache-2.0
"""What whole runs of `run_slam` achieve and cost: prints a Markdown table, a column per sequence.

    python benchmarks/sequences.py [NAMES...] [--runs 3] [--recognizer NAME] [--out FILE]

Names joined by +, such as fr1_xyz+fr1_desk, are run as one map.

Every run is a process of its own, so that speed and memory hold all that a user waits and pays
for: start-up, image decoding, report and map. Only the demo's rendering is timed apart. Nothing is
downloaded: a sequence that is not on this machine is left out.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from placerec.files import cache_folder
from slam.cli import DEFAULT_RECOGNIZER, DEMO

NAMES = (DEMO, "fr1_desk", "fr1_xyz")
SAME_EVERY_RUN = ("trajectory.txt", "loops.jsonl")
LIBRARIES = ("loopclose", "numpy", "opencv-python-headless", "gtsam", "open3d", "torch")
RENDER = (
    "import pathlib, sys; from slam.demo.recording import render_sequence;"
    " render_sequence(pathlib.Path(sys.argv[1]))"
)


class ProcessError(Exception):
    """A process ended with an error; the message is the last line it wrote."""


@dataclass(frozen=True)
class Run:
    """One run: what it cost, its summary.json, and the bytes that no other run may change."""

    seconds: float
    cpu_s: float
    peak_memory_mb: float
    summary: dict[str, Any]
    outputs: tuple[bytes, ...]

    @property
    def frames(self) -> int:
        """Frames read, tracked or not."""
        return int(self.summary["frames_tracked"] + self.summary["frames_untracked"])

    @property
    def unstaged_s(self) -> float:
        """Seconds before the first frame and after the last: start-up, report, map."""
        return float(self.seconds - self.summary["elapsed_s"])


@dataclass(frozen=True)
class Measured:
    """A sequence and all its runs; rendering_s is None where nothing was rendered."""

    name: str
    runs: list[Run]
    rendering_s: float | None = None


def run_python(arguments: list[str], log: Path) -> tuple[float, float, float]:
    """Run Python to its end and return what it took: seconds, CPU seconds, peak memory in MB.

    Raises:
        ProcessError: it ended with an error.
    """
    start_s = time.perf_counter()
    with log.open("wb") as output:
        process = subprocess.Popen([sys.executable, *arguments], stdout=output, stderr=output)
        # Unlike getrusage, wait4 tells of this one child alone.
        _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start_s
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        words = log.read_text(errors="replace").strip()
        raise ProcessError(words.splitlines()[-1] if words else f"exit code {process.returncode}")
    units_per_mb = 1024.0 if sys.platform == "linux" else 1024.0**2  # macOS counts bytes
    return seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / units_per_mb


def measure(name: str, sequences: list[str], recognizer: str, runs: int) -> Measured:
    """Run one sequence, or several as one map, several times.

    Raises:
        ProcessError: a run failed.
    """
    with tempfile.TemporaryDirectory(prefix="loopclose-") as scratch:
        folder, log = Path(scratch) / "run", Path(scratch) / "log"
        rendering_s = None
        if DEMO in sequences:
            rendering_s, *_ = run_python(["-c", RENDER, str(folder / "sequence")], log)
        command = ["-m", "slam.cli", *sequences, "--out", str(folder), "--recognizer", recognizer]
        done = []
        for _ in range(runs):
            cost = run_python(command, log)
            summary = json.loads((folder / "summary.json").read_text())
            outputs = tuple((folder / output).read_bytes() for output in SAME_EVERY_RUN)
            done.append(Run(*cost, summary, outputs))
        return Measured(name, done, rendering_s)


def find(name: str) -> str | None:
    """Return what to call run_slam with, or None where the sequence is not on this machine."""
    if name == DEMO or Path(name).is_dir():
        return name
    data = os.environ.get("LOOPCLOSE_DATA", Path(__file__).parents[2] / "shared" / "data")
    folders = (f"rgbd_dataset_freiburg{name.removeprefix('fr')}", name)
    paths = [root / folder for root in (Path(data), cache_folder()) for folder in folders]
    return next((str(path) for path in paths if (path / "rgb.txt").is_file()), None)


def table(measured: list[Measured]) -> str:
    """Return the Markdown table: accuracy from the first run, costs as the median of all."""
    stages = dict.fromkeys(s for each in measured for s in each.runs[0].summary["stage_seconds"])
    rows = [
        ("frames tracked", _summary("{frames_tracked} of {frames}")),
        ("ATE, m: odometry → corrected", _summary("{ate_before_m} → {ate_after_m}")),
        ("RPE, m", _summary("{rpe_translation_before_m} → {rpe_translation_after_m}")),
        ("RPE, degrees", _summary("{rpe_rotation_before_deg} → {rpe_rotation_after_deg}")),
        ("RPE interval, s", _summary("{rpe_interval_s}")),
        ("loops tried", _summary("{loops_tried}")),
        ("loops accepted", _summary("{loops_accepted}")),
        ("loops outvoted by the graph", _summary("{loops_outvoted}")),
        ("false loops among the accepted", _summary("{loops_false} of {loops_judged} judged")),
        ("frames/s, whole process", _median(lambda run: run.frames / run.seconds)),
        *((f"ms per frame: {stage}", _median(_stage_ms(stage))) for stage in stages),
        ("CPU seconds, whole process", _median(lambda run: run.cpu_s)),
        ("seconds for start-up, report, map", _median(lambda run: run.unstaged_s)),
        ("seconds for rendering, apart", lambda measured: _text(measured.rendering_s)),
        ("peak memory, MB", _median(lambda run: run.peak_memory_mb)),
        (f"runs with the same {' and '.join(SAME_EVERY_RUN)}", _reproducibility),
    ]
    lines = ["|  | " + " | ".join(each.name for each in measured) + " |"]
    lines += ["|---" * (len(measured) + 1) + "|"]
    lines += [f"| {title} | " + " | ".join(map(cell, measured)) + " |" for title, cell in rows]
    return "\n".join(lines)


def _summary(template: str) -> Callable[[Measured], str]:
    def cell(measured: Measured) -> str:
        first = measured.runs[0]
        values = {**first.summary, "frames": first.frames}
        return template.format_map({name: _text(value) for name, value in values.items()})

    return cell


def _median(figure: Callable[[Run], float]) -> Callable[[Measured], str]:
    def cell(measured: Measured) -> str:
        values = [figure(run) for run in measured.runs]
        return f"{statistics.median(values):.1f} ({min(values):.1f}-{max(values):.1f})"

    return cell


def _stage_ms(stage: str) -> Callable[[Run], float]:
    return lambda run: float(run.summary["stage_ms_per_frame"].get(stage, 0.0))


def _reproducibility(measured: Measured) -> str:
    same = sum(run.outputs == measured.runs[0].outputs for run in measured.runs)
    return f"{same} of {len(measured.runs)}"


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def machine() -> str:
    """Return what the figures depend on besides the code, in one line."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = ", ".join(f"{library} {version(library)}" for library in LIBRARIES)
    load = f"load {os.getloadavg()[0]:.1f} at the start"
    system = f"{platform.system()} {platform.machine()}"
    return f"{system}, {cores} cores, {load}; Python {platform.python_version()}, {versions}"


def main(arguments: list[str] | None = None) -> int:
    """Measure, print and write; return 1 where no sequence could be measured."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("names", nargs="*", default=NAMES, help="benchmark names or folders")
    parser.add_argument("--runs", type=int, default=3, help="runs of each sequence")
    parser.add_argument("--recognizer", default=DEFAULT_RECOGNIZER, help="as for run_slam")
    parser.add_argument("--out", type=Path, help="a file that the table is written to as well")
    parsed = parser.parse_args(arguments)
    if parsed.runs < 1:
        parser.error(f"--runs {parsed.runs}: at least one is needed")
    facts, measured = machine(), []
    for name in parsed.names:
        parts = [name] if Path(name).is_dir() else name.split("+")
        sequences = [found for found in map(find, parts) if found is not None]
        if len(sequences) < len(parts):
            print(f"left out, not on this machine: {name}", file=sys.stderr)
            continue
        try:
            title = "+".join(Path(each).name for each in parts)
            measured.append(measure(title, sequences, parsed.recognizer, parsed.runs))
        except ProcessError as error:
            print(f"left out, it failed ({error}): {name}", file=sys.stderr)
    if not measured:
        return 1
    caption = f"Recognizer {parsed.recognizer}; median (range) of {parsed.runs} runs; {facts}."
    text = f"{table(measured)}\n\n{caption}\n"
    print(text, end="")
    if parsed.out:
        parsed.out.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())

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
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from placerec.files import cache_folder
from slam.commands.opening import DEFAULT_RECOGNIZER, DEMO

NAMES = (DEMO, "fr1_desk", "fr1_xyz")
SAME_EVERY_RUN = ("trajectory.txt", "loops.jsonl")
LIBRARIES = ("loopclose", "numpy", "opencv-python-headless", "gtsam", "open3d", "torch")
RENDER = (
    "import pathlib, sys; from slam.demo.recording import render_sequence;"
    " render_sequence(pathlib.Path(sys.argv[1]))"
)


ACCURACY = {
    "frames tracked": "{frames_tracked} of {frames}",
    "ATE, m: odometry, live": "{ate_odometry_m}",
    "ATE, m: corrected, live": "{ate_live_m}",
    "ATE, m: in the end, without loops": "{ate_without_loops_m}",
    "ATE, m: in the end, with loops": "{ate_corrected_m}",
    "RPE, m: odometry → with loops": "{rpe_translation_odometry_m} → {rpe_translation_corrected_m}",
    "RPE, degrees": "{rpe_rotation_odometry_deg} → {rpe_rotation_corrected_deg}",
    "RPE interval, s": "{rpe_interval_s}",
    "median NEES (5.35 is right): links, loops": "{nees_links_median}, {nees_loops_median}",
    "loops tried": "{loops_tried}",
    "loops verified by geometry": "{loops_verified}",
    "loops accepted": "{loops_accepted}",
    "keyframes with a loop": "{keyframes_with_loop}",
    "loops outvoted by the graph": "{loops_outvoted}",
    "false loops among the accepted": "{loops_false} of {loops_judged} judged",
}


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
        command = ["-m", "slam", *sequences, "--out", str(folder), "--recognizer", recognizer]
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
    columns = [_column(each, list(stages)) for each in measured]
    lines = ["|  | " + " | ".join(each.name for each in measured) + " |"]
    lines += ["|---" * (len(measured) + 1) + "|"]
    lines += [
        f"| {row} | " + " | ".join(column[row] for column in columns) + " |" for row in columns[0]
    ]
    return "\n".join(lines)


def _column(measured: Measured, stages: list[str]) -> dict[str, str]:
    runs = measured.runs
    first = runs[0].summary
    frames = first["frames_tracked"] + first["frames_untracked"]
    words = {name: _text(value) for name, value in {**first, "frames": frames}.items()}
    stages_ms = [run.summary["stage_ms_per_frame"] for run in runs]
    same = sum(run.outputs == runs[0].outputs for run in runs)
    return {
        **{title: template.format_map(words) for title, template in ACCURACY.items()},
        "frames/s, whole process": _median([frames / run.seconds for run in runs]),
        **{
            f"ms per frame: {stage}": _median([each.get(stage, 0.0) for each in stages_ms])
            for stage in stages
        },
        "CPU seconds, whole process": _median([run.cpu_s for run in runs]),
        "seconds for start-up, report, map": _median(
            [run.seconds - run.summary["elapsed_s"] for run in runs]
        ),
        "seconds for rendering, apart": _text(measured.rendering_s),
        "peak memory, MB": _median([run.peak_memory_mb for run in runs]),
        f"runs with the same {' and '.join(SAME_EVERY_RUN)}": f"{same} of {len(runs)}",
    }


def _median(values: list[float]) -> str:
    return f"{statistics.median(values):.1f} ({min(values):.1f}-{max(values):.1f})"


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

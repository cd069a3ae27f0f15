# SPDX-License-Identifier: Apache-2.0
"""What runs that are killed lose and leave behind: prints a Markdown table, exit code 1 if wrong.

    python benchmarks/kills.py [--kills 40] [--seed 0] [--seconds 20]

Two recordings are rendered. Runs of the second are killed, by SIGKILL, SIGTERM and SIGINT in turn,
at random times, every other one while it writes its outputs, in a folder that holds those of the
first. Then no file may be torn, no two may be of different runs, and what the run had tracked more
than five seconds before has to be kept: by itself, or by `run_slam FOLDER --finish`.
"""

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from slam import SlamError, read_tum
from slam.demo import render_sequence
from slam.output.claimed_folder import OUTPUTS, UNFINISHED
from slam.output.ledger.reading import read_ledger
from slam.types import Camera

MOST_LOST_S = 5.0
NOTHING_YET = "before it had tracked anything"
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
CAMERA = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
# The command, which also notes when each frame was tracked, for the harness alone.
RUN = """
import os, sys, time
from slam.__main__ import main
from slam.system import Slam
notes = os.open(sys.argv.pop(1), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
process = Slam.process
def noted(slam, frame):
    tracked = process(slam, frame)
    os.write(notes, f"{time.time()} {frame.timestamp_s}\\n".encode())
    return tracked
Slam.process = noted
sys.exit(main())
"""


@dataclass(frozen=True)
class Killed:
    """What became of a run.

    Attributes:
        sent: the signal's name; by which.
        is_writing: whether it was to be killed while it wrote.
        code: its exit code.
        lost_s: how long before it was killed the first frame was tracked that is not kept.
        wrong: what must not be, one sentence each.
    """

    sent: str
    is_writing: bool
    code: int
    lost_s: float
    wrong: tuple[str, ...]


def run_slam(recording: Path, out: Path, notes: Path) -> subprocess.Popen[bytes]:
    """Start a run."""
    command = [sys.executable, "-c", RUN, str(notes), str(recording), "--out", str(out)]
    quiet = subprocess.DEVNULL
    return subprocess.Popen([*command, "--recognizer", "gradients"], stdout=quiet, stderr=quiet)


def flaws(out: Path, first: Path) -> list[str]:
    """Return what is wrong with the files of a folder that may be the first run's or another's."""
    present = [out / name for name in OUTPUTS if (out / name).exists()]
    wrong = [f"{path.name} is torn" for path in present if not is_whole(path)]
    present = [path for path in present if path.stat().st_size]  # a ledger without loops
    of_first = [path.name for path in present if same(path, first / path.name)]
    titles = {path.name for path in present} - set(of_first)
    if of_first and titles:
        wrong.append(f"{', '.join(of_first)} of one run, {', '.join(sorted(titles))} of another")
    return wrong


def same(one: Path, other: Path) -> bool:
    """Return whether two files have the same bytes."""
    return other.exists() and one.read_bytes() == other.read_bytes()


def is_whole(path: Path) -> bool:
    """Return whether a file has its end."""
    try:
        if path.suffix == ".txt":
            read_tum(path)
        elif path.suffix == ".jsonl":
            read_ledger(path)
            return path.read_bytes()[-1:] in (b"", b"\n")
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".html":
            return path.read_text().rstrip().endswith("</html>")
        elif path.suffix == ".ply":
            header, points = path.read_bytes().split(b"end_header\n", 1)
            return len(points) == 15 * int(header.split(b"element vertex ")[1].split()[0])
    except (SlamError, ValueError, IndexError):
        return False
    return True


def kill_one(
    recording: Path, first: Path, scratch: Path, number: int, is_writing: bool, rng: random.Random
) -> Killed:
    """Kill a run that began in a folder with the outputs of the first; look at what there is."""
    out, notes = scratch / f"out{number}", scratch / f"notes{number}"
    shutil.copytree(first, out)
    process = run_slam(recording, out, notes)
    started = out / UNFINISHED / ("odometry.txt" if is_writing else "trajectory.txt")
    while not started.exists() and process.poll() is None:
        time.sleep(0.001)
    time.sleep(rng.uniform(0.0, 0.5 if is_writing else 6.0))
    sent, killed_s = SIGNALS[number // 2 % len(SIGNALS)], time.time()
    process.send_signal(sent)
    code = process.wait()
    wrong = flaws(out, first)
    if (out / UNFINISHED).exists():
        finish = [sys.executable, "-m", "slam", str(out), "--finish"]
        finished = subprocess.run(finish, capture_output=True, text=True, check=False)
        wrong += flaws(out, first)
        if finished.returncode and NOTHING_YET not in finished.stderr:
            wrong.append(finished.stderr.strip())
    tracked = [[float(value) for value in line.split()] for line in notes.read_text().splitlines()]
    kept_s = read_tum(out / "trajectory.txt").timestamps_s[-1]
    if same(out / "trajectory.txt", first / "trajectory.txt"):
        kept_s = -1.0
    lost = [when_s for when_s, timestamp_s in tracked if when_s < killed_s and timestamp_s > kept_s]
    lost_s = killed_s - lost[0] if lost else 0.0
    if lost_s > MOST_LOST_S:
        wrong.append(f"{lost_s:.1f} s of work are lost")
    hidden = [path.name for path in out.iterdir() if path.name not in OUTPUTS]
    if hidden:
        wrong.append(f"{', '.join(hidden)} left over")
    return Killed(sent.name, is_writing, code, lost_s, tuple(wrong))


def kill(kills: int, seed: int, seconds: float, scratch: Path) -> list[Killed]:
    """Render the recordings, and kill so many runs."""
    rng = random.Random(seed)
    for number in range(2):
        render_sequence(scratch / f"recording{number}", seconds, number, camera=CAMERA)
    first = scratch / "first"
    run_slam(scratch / "recording0", first, scratch / "notes").wait()
    recording = scratch / "recording1"
    return [
        kill_one(recording, first, scratch, number, number % 2 == 0, rng) for number in range(kills)
    ]


def table(killed: list[Killed]) -> str:
    """Return a row per signal and time as Markdown."""
    lines = ["| killed by | while | runs | most lost (s) | wrong |", "|---|---|---|---|---|"]
    for sent, is_writing in sorted({(each.sent, each.is_writing) for each in killed}):
        some = [each for each in killed if (each.sent, each.is_writing) == (sent, is_writing)]
        wrong = "; ".join(text for each in some for text in each.wrong) or "nothing"
        lost_s = max(each.lost_s for each in some)
        doing = "writing" if is_writing else "tracking"
        lines.append(f"| {sent} | {doing} | {len(some)} | {lost_s:.1f} | {wrong} |")
    return "\n".join(lines)


def main() -> int:
    """Kill runs and print what became of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the recordings")
    told = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        killed = kill(told.kills, told.seed, told.seconds, Path(scratch))
    print(table(killed))
    return int(any(each.wrong for each in killed))


if __name__ == "__main__":
    sys.exit(main())

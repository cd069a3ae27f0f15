# SPDX-License-Identifier: Apache-2.0
"""What a batch loses when one of two nodes is killed; the exit code is 1 if anything.

    python -m benchmarks.large_maps.batch [--recordings 12] [--recognizer NAME] [--keep DIR]

A room is rendered and cut into short recordings. `run_slam batch` runs on them on two Ray nodes of
this machine, one core each. When a third of the runs are done, and both nodes are at one, the
second is killed (SIGKILL). Then all have to be done, those that were done before the kill must not
have been done again, and every run has to have the same bytes as `run_slam` writes by itself, times
apart. At last a second batch into the same folder must not run anything.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

from slam.demo import render_sequence
from slam.output.claimed_folder import JOURNAL, OUTPUTS, UNFINISHED
from slam.types import Camera

CAMERA = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
FRAMES, APART, FRAMES_PER_S = 60, 30, 15
LISTS = ("rgb.txt", "depth.txt")
TIMED = {"elapsed_s", "compiling_s", "frames_per_second", "stage_seconds", "stage_ms_per_frame"}
WITH_TIMES = ("summary.json", "report.html")
SLAM = (sys.executable, "-m", "slam")


def cut(scratch: Path, count: int) -> list[Path]:
    """Render one long recording, and return the folders of so many short ones out of it."""
    whole = scratch / "whole"
    render_sequence(whole, (FRAMES + APART * (count - 1)) / FRAMES_PER_S, camera=CAMERA)
    rows = {name: (whole / name).read_text().splitlines() for name in LISTS}
    folders = [scratch / "recordings" / f"cut{n:02d}" for n in range(count)]
    for n, folder in enumerate(folders):
        folder.mkdir(parents=True)
        for name in ("camera.toml", "groundtruth.txt"):
            shutil.copy(whole / name, folder)
        for name, lines in rows.items():
            some = [each for each in lines if not each.startswith("#")]
            some = some[n * APART : n * APART + FRAMES]
            (folder / name).write_text("\n".join(some) + "\n")
        for kind in ("rgb", "depth"):
            (folder / kind).symlink_to(whole / kind)
    return folders


def done(runs: Path) -> dict[str, bytes]:
    """Return the summaries, which tell how long a run took, of the runs that are done."""
    return {each.parent.name: each.read_bytes() for each in runs.glob("*/summary.json")}


def under_way(runs: Path) -> list[str]:
    """Return the names of the runs that have begun and are not done."""
    return [each.parent.parent.name for each in runs.glob(f"*/{UNFINISHED}/{JOURNAL}")]


def batch_on_two_nodes(listed: Path, runs: Path, recognizer: str, kill_at: int) -> dict[str, bytes]:
    """Run a batch, kill a node on the way, and return the summaries that there were then.

    Raises:
        SystemExit: the batch failed.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    cluster = Cluster()
    try:
        cluster.add_node(num_cpus=1, include_dashboard=False)
        second = cluster.add_node(num_cpus=1)
        command = [*SLAM, "batch", str(listed), "--out", str(runs), "--recognizer", recognizer]
        started = time.perf_counter()
        batch = subprocess.Popen([*command, "--address", cluster.address])
        while batch.poll() is None and (len(done(runs)) < kill_at or len(under_way(runs)) < 2):
            time.sleep(0.01)
        going = under_way(runs)
        cluster.remove_node(second, allow_graceful=False)
        before = done(runs)
        told = f"{len(before)} runs done, {' and '.join(going)} under way"
        print(f"a node was killed after {time.perf_counter() - started:.0f} s: {told}")
        if batch.wait():
            sys.exit("the batch failed")
        print(f"the batch was over after {time.perf_counter() - started:.0f} s")
    finally:
        cluster.shutdown()
    return before


def differing(one: Path, other: Path) -> list[str]:
    """Return the names of the files in which two runs differ, but for times."""
    names = [name for name in OUTPUTS if name not in WITH_TIMES]
    wrong = [name for name in names if content(one / name) != content(other / name)]
    summaries = [json.loads((each / "summary.json").read_text()) for each in (one, other)]
    plain = [{k: v for k, v in each.items() if k not in TIMED} for each in summaries]
    return wrong if plain[0] == plain[1] else [*wrong, "summary.json"]


def content(path: Path) -> bytes | None:
    """Return what a file holds, None where there is none."""
    return path.read_bytes() if path.exists() else None


def check(scratch: Path, count: int, recognizer: str) -> list[str]:
    """Return what is wrong, one sentence each."""
    recordings = cut(scratch, count)
    listed, runs, alone = scratch / "list.txt", scratch / "runs", scratch / "alone"
    listed.write_text("".join(f"{each}\n" for each in recordings))
    before = batch_on_two_nodes(listed, runs, recognizer, kill_at=count // 3)
    after = done(runs)
    wrong = [f"{each.name} is lost" for each in recordings if each.name not in after]
    wrong += [f"{name} was done twice" for name, told in before.items() if after[name] != told]
    if left := list(runs.glob(f"*/{UNFINISHED}")):
        wrong.append(f"{len(left)} runs left something unfinished")
    for each in recordings:
        out = alone / each.name
        command = [*SLAM, str(each), "--out", str(out), "--recognizer", recognizer, "-q"]
        subprocess.run(command, check=True)
        files = differing(runs / each.name, out)
        wrong += [f"{each.name} alone: another {', '.join(files)}"] if files else []
    again = [*SLAM, "batch", str(listed), "--out", str(runs), "--recognizer", recognizer, "-q"]
    subprocess.run(again, check=True)
    return wrong if done(runs) == after else [*wrong, "a second batch ran what was done"]


def main() -> int:
    """Kill a node, and print what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=12)
    parser.add_argument("--recognizer", default="learned")
    parser.add_argument("--keep", type=Path, help="an empty folder to leave all in")
    told = parser.parse_args()
    place = nullcontext(told.keep) if told.keep else tempfile.TemporaryDirectory()
    with place as scratch:
        wrong = check(Path(scratch), told.recordings, told.recognizer)
    all_same = f"all {told.recordings} runs are done once, with the bytes of each run alone"
    print("\n".join(wrong) or all_same)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""How long it takes to begin: prints a Markdown table of medians, each of fresh processes.

    python benchmarks/startup.py [SEQUENCE] [--runs 5]

`import slam`, `run_slam --help`, and from starting `run_slam SEQUENCE` until it has tracked the
first frame. One run before them finds what the others find: files in the system's memory, and
compiled loops on the disk.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time

# The first frame is tracked, and that is all.
FIRST_FRAME = """
import os, sys
from slam.__main__ import main
from slam.system import Slam

def first(self, frame, process=Slam.process):
    process(self, frame)
    os._exit(0)

Slam.process = first
sys.exit(main(sys.argv[1:]))
"""


def seconds(command: list[str]) -> float:
    """Return how long a process takes that has to end well."""
    start_s = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start_s


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("sequence", nargs="?", default="fr1_desk", metavar="SEQUENCE")
    parser.add_argument("--runs", type=int, default=5)
    parsed = parser.parse_args(arguments)
    python = sys.executable
    print("| | median, s | slowest, s |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, command in (
            ("`import slam`", [python, "-c", "import slam"]),
            ("`run_slam --help`", [python, "-m", "slam", "--help"]),
            (
                f"first frame of {parsed.sequence}",
                [python, "-c", FIRST_FRAME, parsed.sequence, "--out", f"{folder}/run"],
            ),
        ):
            seconds(command)
            taken_s = [seconds(command) for _ in range(parsed.runs)]
            print(f"| {name} | {statistics.median(taken_s):.2f} | {max(taken_s):.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""Whether the tests of the core notice when it is broken on purpose.

mutmut makes thousands of small changes to slam's tracking, mapping, loops, pose_graph, geometry and
evaluation: another operator, a missing argument, another number or text. Of these mutants a sample
is drawn, from each folder its share. One is killed if a test that runs the changed function fails
or takes too long; what survives is printed with the line it changes. Which tests are run stands in
pyproject.toml, as [tool.mutmut].

A mutant is drawn by a hash of the seed and its name, so that most of a sample stays the same while
the code changes elsewhere. All is kept in the folder `mutants`, which may be deleted.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from hashlib import sha256
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FOLDERS = ("tracking", "mapping", "loops", "pose_graph", "geometry", "evaluation")
KILLED = ("killed", "timeout", "segfault")


def pytest_configure() -> None:
    """Try the same examples every time, and lose no time on the simplest: a plug-in of pytest."""
    from hypothesis import Phase, settings

    phases = (Phase.explicit, Phase.generate)
    settings.register_profile("mutants", derandomize=True, database=None, phases=phases)
    settings.load_profile("mutants")


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Let the quick tests come first, and last those that need the rendered recording."""
    stats = Path("mutmut-stats.json")
    took_s = json.loads(stats.read_text())["duration_by_test"] if stats.exists() else {}
    items.sort(key=lambda item: ("recording" in item.fixturenames, took_s.get(item.nodeid, 0.0)))


def exit_codes() -> dict[str, int | None]:
    """Return what became of every mutant, by its name."""
    found: dict[str, int | None] = {}
    for path in sorted(Path("mutants/slam").rglob("*.meta")):
        found |= json.loads(path.read_text())["exit_code_by_key"]
    return found


def draw(names: list[str], count: int, seed: int) -> dict[str, list[str]]:
    """Return by folder which of the mutants are tried."""
    drawn = {}
    for folder in FOLDERS:
        inside = [name for name in names if name.startswith(f"slam.{folder}.")]
        inside.sort(key=lambda name: sha256(f"{seed} {name}".encode()).digest())
        drawn[folder] = inside[: round(count * len(inside) / len(names))]
    return drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=240, help="mutants to try")
    parser.add_argument("--seed", type=int, default=0, help="another seed draws other mutants")
    parser.add_argument("--processes", type=int, default=2, help="mutants tried at the same time")
    asked = parser.parse_args()
    os.chdir(ROOT)
    from mutmut.__main__ import copy_also_copy_files, copy_src_dir, create_mutants
    from mutmut.stats import status_by_exit_code

    copy_src_dir()
    copy_also_copy_files()
    create_mutants(asked.processes)
    drawn = draw(list(exit_codes()), asked.count, asked.seed)
    tried = [name for names in drawn.values() for name in names]
    mutmut = [sys.executable, "-m", "mutmut"]
    with tempfile.TemporaryDirectory() as rendered:
        run = [*mutmut, "run", "--max-children", str(asked.processes), *tried]
        subprocess.run(run, check=True, env=os.environ | {"LOOPCLOSE_RENDERED": rendered})
    codes = exit_codes()
    survivors = [name for name in tried if status_by_exit_code[codes[name]] not in KILLED]
    for name in survivors:
        print(subprocess.run([*mutmut, "show", name], capture_output=True, text=True).stdout)
    for folder, names in drawn.items():
        counts = Counter(status_by_exit_code[codes[name]] for name in names)
        print(f"{folder}: {len(names)} mutants, " + ", ".join(f"{n} {s}" for s, n in counts.items()))
    killed = len(tried) - len(survivors)
    print(f"{killed} of {len(tried)} mutants killed, {100 * killed / len(tried):.1f} %")


if __name__ == "__main__":
    main()

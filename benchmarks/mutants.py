# SPDX-License-Identifier: Apache-2.0
"""Whether the tests of the core notice when it is broken on purpose.

mutmut makes thousands of small changes to the core: another operator, number or text, a missing
argument. A sample is drawn, from each folder its share, by a hash of the seed and the name, so that
most of it stays the same while the code changes elsewhere. A mutant is killed if a test that runs
the changed function fails. Each survivor is printed with its change, and so is one whose tests took
too long: that may be a busy machine. [tool.mutmut] of pyproject.toml says which tests are run.
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

FOLDERS = ("tracking", "mapping", "loops", "pose_graph", "geometry", "evaluation")
KILLED = ("killed", "segfault")


def pytest_configure() -> None:
    """Try the same examples every time, and do not look for simpler ones: a plug-in of pytest."""
    from hypothesis import Phase, settings

    phases = (Phase.explicit, Phase.generate)
    settings.register_profile("mutants", derandomize=True, database=None, phases=phases)
    settings.load_profile("mutants")


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Let the quick tests come first, and last those that need the rendered recording."""
    stats = Path("mutmut-stats.json")
    took_s = json.loads(stats.read_text())["duration_by_test"] if stats.exists() else {}
    items.sort(key=lambda item: ("recording" in item.fixturenames, took_s.get(item.nodeid, 0.0)))


def main() -> None:
    """Draw a sample, let mutmut try it, and print what survived and how many were killed."""
    parser = argparse.ArgumentParser(description="How many mutants of the core the tests kill.")
    parser.add_argument("--count", type=int, default=240, help="mutants to try")
    parser.add_argument("--seed", type=int, default=0, help="another seed draws other mutants")
    parser.add_argument("--processes", type=int, default=2, help="mutants tried at the same time")
    asked = parser.parse_args()
    os.chdir(Path(__file__).parents[1])
    from mutmut.__main__ import create_mutants
    from mutmut.stats import status_by_exit_code
    from mutmut.utils.file_utils import copy_also_copy_files, copy_src_dir

    copy_src_dir()
    copy_also_copy_files()
    create_mutants(asked.processes)
    drawn = _draw(list(_exit_codes()), asked.count, asked.seed)
    tried = [name for names in drawn.values() for name in names]
    mutmut = [sys.executable, "-m", "mutmut"]
    with tempfile.TemporaryDirectory() as rendered:
        run = [*mutmut, "run", "--max-children", str(asked.processes), *tried]
        subprocess.run(run, check=True, env=os.environ | {"LOOPCLOSE_RENDERED": rendered})
    became = {name: status_by_exit_code[code] for name, code in _exit_codes().items()}
    survivors = [name for name in tried if became[name] not in KILLED]
    for name in survivors:
        subprocess.run([*mutmut, "show", name], check=True)
    for folder, names in drawn.items():
        print(f"{folder}: {dict(Counter(became[name] for name in names))}")
    print(f"{len(tried) - len(survivors)} of {len(tried)} mutants killed")


def _exit_codes() -> dict[str, int | None]:
    """Return how the tests of every mutant ended, by its name."""
    metas = [json.loads(path.read_text()) for path in sorted(Path("mutants/slam").rglob("*.meta"))]
    return {name: code for meta in metas for name, code in meta["exit_code_by_key"].items()}


def _draw(names: list[str], count: int, seed: int) -> dict[str, list[str]]:
    """Return by folder which of the mutants are tried."""
    names = sorted(names, key=lambda name: sha256(f"{seed} {name}".encode()).digest())
    by_folder = {f: [n for n in names if n.startswith(f"slam.{f}.")] for f in FOLDERS}
    return {f: of[: round(count * len(of) / len(names))] for f, of in by_folder.items()}


if __name__ == "__main__":
    main()

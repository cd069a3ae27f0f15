# SPDX-License-Identifier: Apache-2.0
import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from slam.geometry import compiled
from slam.geometry.compiled import count_bits

SOURCE = """
from slam.geometry.compiled import compiled, load_compiled

@compiled
def added(numbers):
    total = 0.0
    for each in numbers:
        total += each
    return total
"""
RUN = (
    "import numpy as np, loops\n"
    "print(loops.load_compiled(), loops.added(np.arange(4.0)), loops.added.stats.cache_hits)"
)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "loops.py").write_text(SOURCE)
    return tmp_path


def run(folder):
    path = os.pathsep.join([str(folder), *sys.path])
    env = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(folder / "cache")}
    ran = subprocess.run(
        [sys.executable, "-c", RUN], capture_output=True, text=True, env=env, check=True
    )
    return ran.stdout.split()


def test_what_one_run_compiled_the_next_one_loads(folder):
    assert run(folder) == ["False", "6.0", "Counter()"]
    loaded, total, *hits = run(folder)
    assert (loaded, total) == ("True", "6.0") and "1" in "".join(hits)


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_what_a_power_cut_left_is_compiled_again(folder, ending):
    run(folder)
    (damaged,) = (folder / "cache").rglob(f"*.{ending}")
    damaged.write_bytes(b"")
    assert run(folder)[1] == "6.0"
    loaded, total, *hits = run(folder)
    assert (loaded, total) == ("True", "6.0") and "1" in "".join(hits)


def test_a_disk_that_is_full_costs_time_alone(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiled.FunctionCache, "save_overload", full)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "cache"))
    spec = importlib.util.spec_from_file_location("loops_of_a_full_disk", folder / "loops.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.added(np.arange(5.0)) == 10.0


@compiled.compiled
def bits_of(words):
    total = 0
    for word in words:
        total += count_bits(word)
    return total


def test_bits_are_counted():
    words = np.array([0, 1, 2**63, 2**64 - 1], np.uint64)
    assert bits_of(words) == np.bitwise_count(words).sum() == 66

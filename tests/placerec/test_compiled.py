# SPDX-License-Identifier: Apache-2.0
import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from placerec import compiled
from placerec.compiled import count_bits

LOOPS = """
import others
from others import OFFSET, scaled
from placerec.compiled import compiled

@compiled
def added(numbers):
    total = OFFSET
    for each in numbers:
        total += scaled(each) * others.WEIGHT
    return total
"""
OTHERS = """
from placerec.compiled import inlined

FACTOR, WEIGHT, OFFSET = 1.0, 1.0, 0.0

@inlined
def scaled(number):
    return FACTOR * number
"""
RUN = """
import numpy as np, loops
from placerec.compiled import compiling_s, load_compiled, telling_of_compiling

with telling_of_compiling(lambda: print("compiling")):
    load_compiled()
    print(len(loops.added.overloads))
    total = loops.added(np.arange(4.0))
    print(compiling_s() > 0.0, total)
"""
COMPILED, LOADED = ["0", "compiling", "True", "6.0"], ["1", "False", "6.0"]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "loops.py").write_text(LOOPS)
    (tmp_path / "others.py").write_text(OTHERS)
    return tmp_path


def run(folder, **env):
    env |= {
        "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]),
        "PYTHONDONTWRITEBYTECODE": "1",  # which would not see two changes in a second
        "NUMBA_CACHE_DIR": str(folder / "cache"),
    }
    ran = subprocess.run(
        [sys.executable, "-c", RUN],
        capture_output=True,
        text=True,
        env=os.environ | env,
        check=True,
    )
    return ran.stdout.split()


def cached(folder):
    return sorted(path.name for path in (folder / "cache").rglob("*.nb?"))


def test_what_one_run_compiled_the_next_one_loads(folder):
    assert run(folder) == COMPILED
    assert run(folder) == LOADED


def test_another_processor_needs_other_machine_code_and_says_so(folder):
    run(folder)
    assert run(folder, NUMBA_CPU_NAME="generic") == COMPILED
    assert run(folder, NUMBA_CPU_NAME="generic") == LOADED
    assert run(folder) == LOADED


@pytest.mark.parametrize(
    ("before", "after", "total"),
    [
        ("OFFSET = 1.0, 1.0, 0.0", "OFFSET = 1.0, 1.0, 2.0", "8.0"),
        ("OFFSET = 1.0, 1.0, 0.0", "OFFSET = 1.0, 2.0, 0.0", "12.0"),
        ("OFFSET = 1.0, 1.0, 0.0", "OFFSET = 3.0, 1.0, 0.0", "18.0"),
        ("FACTOR * number", "FACTOR + number", "10.0"),
    ],
    ids=["constant", "in a module", "of what is inlined", "inlined"],
)
def test_what_changes_in_another_file_is_compiled_again_in_place_of_what_was(
    folder, before, after, total
):
    run(folder)
    files = cached(folder)
    assert len(files) == 2
    (folder / "others.py").write_text(OTHERS.replace(before, after))
    assert run(folder) == ["0", "compiling", "True", total]
    assert run(folder) == ["1", "False", total]
    assert cached(folder) == files


def test_a_line_before_a_loop_leaves_it_as_it_is(folder):
    run(folder)
    (folder / "loops.py").write_text("# A comment." + LOOPS)
    assert run(folder) == LOADED


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_what_a_power_cut_left_is_compiled_again(folder, ending):
    run(folder)
    (damaged,) = (folder / "cache").rglob(f"*.{ending}")
    damaged.write_bytes(b"")
    assert run(folder)[-1] == "6.0"
    assert run(folder) == LOADED


def test_a_disk_that_is_full_costs_time_alone(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiled.FunctionCache, "save_overload", full)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "cache"))
    monkeypatch.syspath_prepend(folder)
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

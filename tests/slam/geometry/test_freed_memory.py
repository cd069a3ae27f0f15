# SPDX-License-Identifier: Apache-2.0
import ctypes
import subprocess
import sys

import pytest

from slam.geometry import freed_memory

# Pieces too small to be given back at once, of which every tenth is still in use.
PIECES = """
import numpy as np
from pathlib import Path
from slam.geometry.freed_memory import give_back

def resident_mb():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1000

pieces = [np.ones(8000) for _ in range(2000)]
pieces = pieces[::10]
before = resident_mb()
give_back()
print(before - resident_mb())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="not glibc")
def test_what_was_freed_between_what_is_in_use_is_given_back():
    done = subprocess.run(
        [sys.executable, "-c", PIECES], capture_output=True, text=True, check=True
    )
    assert float(done.stdout) > 80.0  # of 115 MB


@pytest.mark.parametrize("problem", [OSError, AttributeError, TypeError])
def test_another_c_library_is_left_to_itself(monkeypatch, problem):
    def none(_):
        raise problem

    monkeypatch.setattr(ctypes, "CDLL", none)
    freed_memory.share_between_threads()
    freed_memory.give_back()

# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys

import pytest

# Tells how many threads BLAS is to have at the moment when a command loads NumPy.
LOADED = """
import importlib, os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            print(os.environ.get("OPENBLAS_NUM_THREADS"))

sys.meta_path.insert(0, Watch())
importlib.import_module(sys.argv[1])
"""


@pytest.mark.parametrize(
    "command", ["slam.__main__", "slam.commands.drift_report", "placerec.commands.evaluate"]
)
@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({}, "1"),
        ({"OPENBLAS_NUM_THREADS": "4"}, "4"),
        ({"OMP_NUM_THREADS": "3"}, "None"),  # BLAS takes this then
    ],
)
def test_blas_has_one_thread_unless_it_is_asked_for_more(command, asked, told):
    told_before = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    environment = {k: v for k, v in os.environ.items() if k not in told_before}
    done = subprocess.run(
        [sys.executable, "-c", LOADED, command],
        env=environment | asked,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == [told]

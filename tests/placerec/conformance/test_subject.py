# SPDX-License-Identifier: Apache-2.0
import math
from pathlib import Path

import numpy as np
import pytest

from placerec.conformance.made_images import places
from placerec.conformance.subject import run_in_fresh_process
from placerec.errors import RecognizerError
from placerec.recognizer import load

MODULE = """
import os, sys
import numpy as np

class Mean:
    min_similarity = 0.9

    def embed(self, image):
        print("to stdout")
        return np.float32([image.mean(), os.getpid()])

class NotNow(Mean):
    def embed(self, image):
        raise ValueError("not\\nnow")

class NotAgain(Mean):
    def __init__(self):
        raise OSError("gone")

class Leaves(Mean):
    def embed(self, image):
        os._exit(7)
"""


@pytest.fixture(autouse=True)
def written(tmp_path, monkeypatch):
    (tmp_path / "written.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)


def test_the_places_are_embedded_in_another_process():
    run = run_in_fresh_process("written:Mean")
    here = np.stack([load("written:Mean").embed(image) for image in places()])
    np.testing.assert_array_equal(run.embeddings[:, 0], here[:, 0])
    assert run.embeddings[0, 1] != here[0, 1]
    assert run.embeddings.dtype == np.float32


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells")
def test_memory_is_told():
    run = run_in_fresh_process("written:Mean")
    assert 0 <= run.own_mb < 1000
    assert math.isfinite(run.kept_mb)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("written:NotAgain", "'written:NotAgain' cannot be constructed: OSError: gone"),
        ("written:NotNow", "^now$"),
        ("written:Leaves", "it ended with code 7"),
        ("no-such-thing", "there is no recognizer 'no-such-thing'"),
    ],
)
def test_what_fails_there_is_told_here(name, message):
    with pytest.raises(RecognizerError, match=message):
        run_in_fresh_process(name)

# SPDX-License-Identifier: Apache-2.0
"""Whatever a file holds, its reader answers with a value or with one line."""

import os
from contextlib import suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.fuzz.mutations import WORDS, mutated
from benchmarks.fuzz.readers import READERS
from placerec.errors import LoopcloseError

EXAMPLES = settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
ANSWERS = ("read", "refused", "broken")
every_reader = pytest.mark.parametrize("name", READERS)
PARTS = st.lists(st.sampled_from(WORDS) | st.binary(max_size=40), max_size=8)


@pytest.fixture(scope="module")
def laid_out(tmp_path_factory):
    folders = {}

    def lay_out(name):
        if name not in folders:
            folder = tmp_path_factory.mktemp("reader")
            folders[name] = folder, READERS[name].lay_out(folder)
        return folders[name]

    return lay_out


@every_reader
def test_a_good_file_is_read(laid_out, name):
    folder, good = laid_out(name)
    assert READERS[name].try_out(folder, good) == "read"


@every_reader
@EXAMPLES
@given(seed=st.integers(0, 2**32))
def test_a_damaged_file_is_read_or_refused_in_one_line(laid_out, name, seed):
    folder, good = laid_out(name)
    damaged = mutated(good, READERS[name].is_text, seed)
    assert READERS[name].try_out(folder, damaged).startswith(ANSWERS)


@every_reader
@EXAMPLES
@given(parts=PARTS)
def test_any_bytes_are_read_or_refused_in_one_line(laid_out, name, parts):
    folder, _ = laid_out(name)
    assert READERS[name].try_out(folder, b"".join(parts)).startswith(ANSWERS)


@every_reader
def test_what_is_no_file_is_refused_at_once(laid_out, name):
    folder, good = laid_out(name)
    path = folder / READERS[name].file
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    try:
        with suppress(LoopcloseError):
            READERS[name].read(folder)
    finally:
        path.unlink(missing_ok=True)
        path.write_bytes(good)

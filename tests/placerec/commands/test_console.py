# SPDX-License-Identifier: Apache-2.0
import os
import signal
import sys
from contextlib import suppress

import pytest

from placerec.commands.console import answer
from placerec.errors import RecognizerError


def fail_with(error):
    def work(_):
        raise error

    return work


def terminate(_):
    signal.raise_signal(signal.SIGTERM)
    return 0


@pytest.mark.parametrize("code", [0, 1])
def test_good_work_says_nothing_and_has_its_own_code(capsys, code):
    typed = []
    assert answer("prog", ["x", "-q"], lambda asked: typed.append(asked) or code, "stopped") == code
    assert typed == [["x"]]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("work", "line"),
    [
        (fail_with(RecognizerError("no such thing")), "no such thing"),
        (fail_with(KeyboardInterrupt()), "stopped"),
        (fail_with(MemoryError("7 PB")), "there is not enough memory: MemoryError: 7 PB"),
        (terminate, "stopped"),
    ],
    ids=["of the user", "Ctrl-C", "memory", "SIGTERM"],
)
def test_what_ends_work_early_is_one_line_and_code_2(capsys, work, line):
    assert answer("prog", [], work, "stopped") == 2
    assert capsys.readouterr().err == f"prog: {line}\n"
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_nobody_has_to_hear_it(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    stderr = os.fdopen(writer, "w", buffering=1)
    monkeypatch.setattr(sys, "stderr", stderr)
    assert answer("prog", [], fail_with(RecognizerError("no")), "stopped") == 2
    with suppress(BrokenPipeError):
        stderr.close()


def test_a_fault_of_ours_is_no_problem_of_the_users():
    with pytest.raises(ZeroDivisionError):
        answer("prog", [], fail_with(ZeroDivisionError()), "stopped")

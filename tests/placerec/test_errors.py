# SPDX-License-Identifier: Apache-2.0
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from placerec.errors import (
    LoopcloseError,
    Salvage,
    cause_of,
    deferred_interrupts,
    terminations_interrupt,
)


def test_first_interrupt_waits_and_the_second_does_not():
    before = signal.getsignal(signal.SIGINT)
    with deferred_interrupts() as interrupted:
        assert not interrupted.is_set()
        signal.raise_signal(signal.SIGINT)
        assert interrupted.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_leave_signals_alone():
    def enter():
        with deferred_interrupts() as interrupted:
            return interrupted.is_set(), signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(enter).result() == (False, signal.getsignal(signal.SIGINT))


def test_a_message_is_one_line_without_what_steers_a_terminal():
    error = LoopcloseError("no image: a\nb\x1b[31m\u202egnp.x\udcff \U0001f600 ä: /tmp/x")
    assert str(error) == r"no image: a\nb\x1b[31m\u202egnp.x\udcff 😀 ä: /tmp/x"


def test_a_long_message_keeps_its_beginning_and_its_path():
    text = str(LoopcloseError(f"line 1 is no pose: {'x' * 10**6}: /tmp/poses.txt"))
    assert len(text) < 700
    assert text.startswith("line 1 is no pose: xxx")
    assert " [... 999435 characters ...] " in text
    assert text.endswith("xxx: /tmp/poses.txt")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_termination_waits_too_and_may_come_again(number):
    before = signal.getsignal(number)
    with deferred_interrupts() as interrupted:
        for _ in range(3):  # `timeout` sends it twice
            signal.raise_signal(number)
        assert interrupted.is_set()
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_termination_ends_a_command_as_ctrl_c_does_but_once(number):
    tidied = False
    with terminations_interrupt():
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            signal.raise_signal(number)
            tidied = True
    assert tidied
    assert signal.getsignal(number) is signal.SIG_DFL


def test_what_whoever_started_the_command_wants_to_be_ignored_is(monkeypatch):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with terminations_interrupt(), deferred_interrupts() as interrupted:
            signal.raise_signal(signal.SIGHUP)
            assert not interrupted.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)


class WordlessError(Exception):
    def __str__(self):
        raise ValueError("no text")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("no\n  good"), "ValueError: no good"),
        (MemoryError(), "MemoryError"),
        (LoopcloseError("choose\nanother"), "choose\\nanother"),
        (WordlessError(), "WordlessError"),
        (SystemExit(0), "SystemExit: 0"),
    ],
)
def test_every_exception_is_one_line(error, line):
    assert cause_of(error) == line


def test_a_stage_that_fails_does_not_cost_the_others():
    salvage = Salvage()

    def fail():
        raise MemoryError("1 GB")

    assert salvage.attempt("the map", fail, "none") == "none"
    assert salvage.attempt("the path", lambda: "here", "none") == "here"
    assert salvage.sentences == ("the map is missing: MemoryError: 1 GB",)


def test_streams_that_are_closed_lead_nowhere_and_lend_their_number_to_no_file(tmp_path):
    code = (
        "import sys; from placerec.errors import replace_closed_streams;"
        "replace_closed_streams(); print('lost'); print('lost too', file=sys.stderr);"
        "file = open(sys.argv[1], 'w'); assert file.fileno() > 2"
    )
    path = tmp_path / "file"
    line = f'{sys.executable} -c "{code}" {path} <&- >&- 2>&-'
    assert subprocess.run(line, shell=True, check=False).returncode == 0
    assert path.read_text() == ""

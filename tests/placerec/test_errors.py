# SPDX-License-Identifier: Apache-2.0
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from placerec.errors import LoopcloseError, deferred_interrupts


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

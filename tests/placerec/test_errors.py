# SPDX-License-Identifier: Apache-2.0
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from placerec.errors import deferred_interrupts


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

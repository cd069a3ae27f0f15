# SPDX-License-Identifier: Apache-2.0
"""What ends a command before it is done: errors that the user can mend, and Ctrl-C."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class LoopcloseError(Exception):
    """A problem that the user can solve: one line that names it and says what to do."""


class RecognizerError(LoopcloseError):
    """A recognizer that cannot be found or misbehaves: one line that says what and whose."""


@contextmanager
def deferred_interrupts() -> Iterator[threading.Event]:
    """Let Ctrl-C only set an event, to be looked at between two steps; a second one interrupts."""
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted  # signals go to the main thread, and only it may ask for them
        return
    usual = signal.getsignal(signal.SIGINT)

    def note(*_: object) -> None:
        interrupted.set()
        signal.signal(signal.SIGINT, usual)

    signal.signal(signal.SIGINT, note)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, usual)

# SPDX-License-Identifier: Apache-2.0
"""What ends a command before it is done: errors that the user can mend, and Ctrl-C."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_MOST_CHARACTERS = 1000  # none of our own messages is longer
_KEPT_CHARACTERS = 300  # of a longer one, from the beginning and from the end, where the path is


class LoopcloseError(Exception):
    """A problem that the user can solve: one line that names it and says what to do.

    What a file or a name brought into it can neither break the line, nor steer a terminal, nor
    fill a screen.
    """

    def __str__(self) -> str:
        text = printable(super().__str__())
        if len(text) <= _MOST_CHARACTERS:
            return text
        left_out = len(text) - 2 * _KEPT_CHARACTERS
        start, end = text[:_KEPT_CHARACTERS], text[-_KEPT_CHARACTERS:]
        return f"{start} [... {left_out} characters ...] {end}"


def printable(text: str) -> str:
    """Return a text with control characters, and those that nothing can show, escaped."""
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in text
    )


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

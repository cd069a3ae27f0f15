# SPDX-License-Identifier: Apache-2.0
"""What would end a command before it is done: errors, signals, closed streams."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar

_T = TypeVar("_T")
_Other = TypeVar("_Other")

_TERMINATIONS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""As batch systems, containers, `timeout` and closed terminals send them."""

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


def cause_of(error: BaseException) -> str:
    """Return an exception as one line."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # a class of somebody else's, whose own text fails
        text = ""
    if isinstance(error, LoopcloseError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class Salvage:
    """Does one stage after the other, and where one fails the rest all the same.

    Attributes:
        missing: why what is missing could not be had.
    """

    def __init__(self) -> None:
        self.missing: dict[str, str] = {}

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is missing and why, one sentence each."""
        return tuple(f"{what} is missing: {why}" for what, why in self.missing.items())

    def attempt(self, what: str, stage: Callable[[], _T], otherwise: _Other) -> _T | _Other:
        """Return what a stage does, or what to go on with where it fails, and note that."""
        try:
            return stage()
        except Exception as error:
            self.missing[what] = cause_of(error)
            return otherwise


@contextmanager
def _handled(
    signals: tuple[int, ...], handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Handle signals, but for those that whoever started the command wants to be ignored."""
    usual = {each: signal.getsignal(each) for each in signals}
    usual = {each: known for each, known in usual.items() if known not in (signal.SIG_IGN, None)}
    for each in usual:
        signal.signal(each, handler)
    try:
        yield
    finally:
        for each, known in usual.items():
            signal.signal(each, known)


@contextmanager
def terminations_interrupt() -> Iterator[None]:
    """Let SIGTERM and SIGHUP do what Ctrl-C does, so that everybody on the way out tidies up."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals go to the main thread, and only it may ask for them
        return
    is_over = False

    def interrupt(*_: object) -> None:
        nonlocal is_over
        if not is_over:  # `timeout` sends it twice, which must not disturb the tidying up
            is_over = True
            raise KeyboardInterrupt

    with _handled(_TERMINATIONS, interrupt):
        yield


@contextmanager
def deferred_interrupts() -> Iterator[threading.Event]:
    """Let Ctrl-C, SIGTERM and SIGHUP only set an event, to be looked at between two steps.

    A second Ctrl-C interrupts. The others, who cannot tell whether they were heard, may come again.
    """
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return
    usual = signal.getsignal(signal.SIGINT)

    def note(number: int, _: object) -> None:
        interrupted.set()
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, usual)

    with _handled((signal.SIGINT, *_TERMINATIONS), note):
        yield interrupted


def replace_closed_streams() -> None:
    """Let standard streams that the command was started without (`>&-`) lead nowhere.

    Their descriptors would else be those of the next files to be opened.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))

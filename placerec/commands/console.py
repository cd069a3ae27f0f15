# SPDX-License-Identifier: Apache-2.0
"""What the commands say while they work: results on stdout, messages on stderr, and progress.

The packages themselves only log, to loggers below `slam` and `placerec`, and never print.
"""

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from tqdm import tqdm

from placerec.errors import (
    LoopcloseError,
    RecognizerError,
    cause_of,
    printable,
    replace_closed_streams,
    terminations_interrupt,
)

_BAD_INPUT = 2
_QUIET, _VERBOSE = ("-q", "--quiet"), ("-v", "--verbose")
_OURS = ("slam", "placerec")
_LINES = 10  # of progress, where they are asked for and no bar can be drawn
# What libraries in C say on their own; they read these when they are loaded.
_LEVELS_IN_C = ("OPENCV_LOG_LEVEL", "TORCH_CPP_LOG_LEVEL")
# Its level says how much: what the commands tell by themselves is INFO.
_log = logging.getLogger(__name__)


def answer(
    prog: str, typed: Sequence[str], work: Callable[[list[str]], int], interrupted: str
) -> int:
    """Do what was typed, and return the exit code: that of the work, or 2 and one line on stderr.

    SIGTERM and SIGHUP do what Ctrl-C does.

    Args:
        prog: the command's name.
        typed: what was typed after it.
        work: does what is left of that.
        interrupted: what there is to say after Ctrl-C.
    """
    replace_closed_streams()
    try:
        with reporting(typed) as asked, terminations_interrupt():
            return work(asked)
    except LoopcloseError as error:
        problem = str(error)
    except KeyboardInterrupt:
        problem = interrupted
    except MemoryError as error:
        problem = f"there is not enough memory: {cause_of(error)}"
    with suppress(OSError):  # nobody looks any more
        print(f"{prog}: {problem}", file=sys.stderr)
    return _BAD_INPUT


@contextmanager
def reporting(typed: Sequence[str]) -> Iterator[list[str]]:
    """Say as much as -q or -v in a command line ask for; yields what else was typed.

    By default warnings, errors and what a command is doing; with -q only warnings and errors; with
    -v also what the packages log, and warnings of other libraries, which are nobody's concern
    otherwise unless Python was told (-W, PYTHONWARNINGS) to show them.

    Raises:
        RecognizerError: both were typed.
    """
    is_quiet, is_verbose = (any(flag in typed for flag in flags) for flags in (_QUIET, _VERBOSE))
    if is_quiet and is_verbose:
        raise RecognizerError("-q says less and -v says more; give one of them")
    if not is_verbose:
        for name in _LEVELS_IN_C:
            os.environ.setdefault(name, "ERROR")
    root, handler = logging.getLogger(), _Lines(is_verbose)
    before = root.level, _log.level
    root.addHandler(handler)
    root.setLevel(logging.INFO if is_verbose else logging.WARNING)
    _log.setLevel(logging.WARNING if is_quiet else logging.INFO)
    if not sys.warnoptions:
        logging.captureWarnings(True)
    try:
        yield [each for each in typed if each not in (*_QUIET, *_VERBOSE)]
    finally:
        logging.captureWarnings(False)
        root.removeHandler(handler)
        root.setLevel(before[0])
        _log.setLevel(before[1])


def say(text: str) -> None:
    """Print a result, unless the command is to be quiet.

    Raises:
        RecognizerError: it cannot be written where stdout goes to, such as a full disk.
    """
    if _log.isEnabledFor(logging.INFO):
        put(text)


def put(text: str) -> None:
    """Print what was asked for; a reader that has gone away, as `head` does, has seen enough.

    Raises:
        RecognizerError: it cannot be written where stdout goes to, such as a full disk.
    """
    stdout = sys.stdout
    try:
        try:
            print(text, flush=True)
        except UnicodeEncodeError:
            encoding = stdout.encoding or "ascii"
            print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except OSError as error:
        # What is left in the buffer would fail once more when the process ends.
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise RecognizerError(f"cannot print to stdout: {error.strerror}") from error


def note(text: str) -> None:
    """Tell on stderr what the command is doing, unless it is to be quiet."""
    _log.info("%s", text)


class _Lines(logging.Handler):
    """Writes every message to stderr as one line, above a progress bar if there is one."""

    def __init__(self, is_verbose: bool) -> None:
        super().__init__()
        self._is_verbose = is_verbose

    def emit(self, record: logging.LogRecord) -> None:
        is_ours = record.name.split(".")[0] in _OURS
        if not is_ours and not (self._is_verbose and record.levelno >= logging.WARNING):
            return
        kind = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        # Without a reader there is nothing to tell; the work is not to end by that.
        with suppress(OSError, ValueError):
            tqdm.write(kind + one_line(self.format(record)), file=sys.stderr)


def one_line(text: str) -> str:
    """Return a text without line breaks, and with what a terminal would obey written as escapes."""
    return printable(" ".join(text.split()))


class ProgressBar:
    """Is told how much is done: a bar on a terminal, at times a line in a log with -v, or nothing.

    It is a `placerec.files.Progress`.
    """

    def __init__(self, title: str, total: int | None, bar: Any) -> None:
        self._title, self._total, self._bar = title, total, bar
        self._lines = 0

    def __call__(self, done: int, total: int | None = None, what: str = "") -> None:
        """Tell how much is done, of how much if that was not known before, and what else."""
        self._total = total or self._total
        if self._bar is None:
            self._log_some(done)
            return
        with suppress(OSError):  # nobody looks any more
            self._bar.total = self._total
            if what:
                self._bar.set_postfix_str(what)
            self._bar.update(done - self._bar.n)

    def _log_some(self, done: int) -> None:
        if self._total and done * _LINES // self._total > self._lines:
            self._lines = done * _LINES // self._total
            logging.getLogger("placerec").info("%s: %d of %d", self._title, done, self._total)


@contextmanager
def progress_bar(
    title: str, total: int | None = None, unit: str = "image", *, is_shown: bool = True
) -> Iterator[ProgressBar]:
    """Show how far it is, as told to what is yielded; bytes, unit "B", as kB, MB and so on."""
    is_watched = is_shown and sys.stderr.isatty() and _log.isEnabledFor(logging.INFO)
    if not is_watched:
        yield ProgressBar(title, total if is_shown else None, None)
        return
    # The delay hides the bar where no progress is ever made.
    with tqdm(
        desc=title,
        total=total,
        unit=unit if unit == "B" else f" {unit}s",
        unit_scale=unit == "B",
        delay=1e-9,
        dynamic_ncols=True,
        leave=False,
    ) as bar:
        yield ProgressBar(title, total, bar)

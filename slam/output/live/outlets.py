# SPDX-License-Identifier: Apache-2.0
"""Where what is shown goes: to a viewer of its own, or into a file; both may fail at any time."""

import atexit
import os
import select
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import rerun as rr

from slam.types import SlamError

_PATIENCE_S = 10.0  # for a viewer that takes nothing
_DISK_PATIENCE_S = 10.0  # which is full: what waits to be written may then never be
_APPLICATION = "loopclose"
_VIEWER = (sys.executable, "-m", "rerun", "-")


class Outlet(Protocol):
    """One place that a recording goes to.

    Attributes:
        recording: Rerun's, to log to.
    """

    recording: Any

    def flush(self) -> None:
        """Send what was logged, and raise what keeps it from arriving."""

    def close(self) -> None:
        """Send the rest and end; raise what keeps it from arriving."""

    def abandon(self) -> None:
        """End after a failure, and leave nothing behind."""


class Viewer:
    """A viewer in a window of its own, which stays open; it reads what goes into a pipe.

    A pipe, because whatever else Rerun offers waits for ever for a viewer that hangs.
    """

    def __init__(self) -> None:
        """Open the window.

        Raises:
            SlamError: there is no display.
            OSError: it cannot be started.
        """
        if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
            raise SlamError("there is no display; keep the run with --rrd FILE, and open that")
        self.recording = _new_recording()
        self._stream = self.recording.binary_stream()
        self._process = subprocess.Popen(
            _VIEWER,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            start_new_session=True,  # Ctrl-C is for the run
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    def flush(self) -> None:
        """Send what was logged.

        Raises:
            OSError: the viewer is closed, or takes nothing any more.
        """
        left = memoryview(self._stream.read(flush=True) or b"")
        until_s = time.monotonic() + _PATIENCE_S
        while left:
            try:
                left = left[os.write(self._pipe, left) :]
            except BlockingIOError:
                if not select.select([], [self._pipe], [], until_s - time.monotonic())[1]:
                    raise TimeoutError("it does not answer") from None
            except BrokenPipeError:
                raise BrokenPipeError("it was closed, or could not open its window") from None

    def close(self) -> None:
        """Send the rest; the window stays.

        Raises:
            OSError: the viewer is closed, or takes nothing any more.
        """
        self.flush()
        self.abandon()

    def abandon(self) -> None:
        """Send no more."""
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        self._process.returncode = 0  # it may outlive us, which is no mistake to be warned of
        self.recording.disconnect()


class File:
    """A file that has its name once it is whole."""

    def __init__(self, path: Path) -> None:
        """Begin it under the name that it has until then.

        Raises:
            SlamError: it cannot be written.
        """
        self._path, self._partial = path, unfinished(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._partial.touch()
        except OSError as error:
            raise SlamError(
                f"cannot write what --rrd keeps: {error.strerror}; choose another file: {path}"
            ) from error
        self.recording = _new_recording()
        self.recording.set_sinks(rr.FileSink(self._partial))

    def flush(self) -> None:
        """Write what was logged.

        Raises:
            RuntimeError: it cannot be written.
        """
        self.recording.flush(timeout_sec=_DISK_PATIENCE_S)

    def close(self) -> None:
        """Write the rest and give the file its name.

        Raises:
            OSError, RuntimeError: it cannot be written.
        """
        self.flush()
        self.recording.disconnect()  # writes where in it is what
        with self._partial.open("rb") as stream:
            os.fsync(stream.fileno())  # a full disk may only show up here
        self._partial.replace(self._path)

    def abandon(self) -> None:
        """Remove it: a full disk has better use for the room."""
        # Rerun may wait for ever for what it could not write, here and when the program ends.
        atexit.unregister(rr.rerun_shutdown)
        threading.Thread(target=self.recording.disconnect, daemon=True).start()
        with suppress(OSError):
            self._partial.unlink(missing_ok=True)


def unfinished(path: Path) -> Path:
    """Return the name that a file has until it is whole; viewers open it all the same."""
    return path.with_name(f"{path.stem}.unfinished.rrd")


def _new_recording() -> Any:
    recording = rr.RecordingStream(_APPLICATION)
    recording.set_log_time_enabled(False)  # when it was logged is when the frame came
    recording.set_log_tick_enabled(False)
    return recording

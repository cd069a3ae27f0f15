# SPDX-License-Identifier: Apache-2.0
"""Images of keyframes, kept compressed: in memory, and in a file where there are many."""

import math
import os
import tempfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.types import Frame, SlamError

_JPEG_QUALITY = 90
_ZLIB_LEVEL = 1  # as a PNG of level 1, in two thirds of the time


class Previews:
    """Keeps small frames until the last of them is forgotten.

    Colour becomes a JPEG; depth is kept to the last bit.
    """

    def __init__(self, most_bytes: int, depth_scale: float, folder: Path | None = None) -> None:
        """Keep so many bytes in memory; the rest goes to a file without a name in a folder.

        The default is the system's folder of temporary files. Depth that is a whole number of units
        per metre, `depth_scale`, takes least.
        """
        self._left = most_bytes
        self._depth_scale = np.float32(depth_scale)
        self._folder = folder
        self._file: _NamelessFile | None = None

    def keep(self, frame: Frame) -> Frame:
        """Return the frame again, with images that are decoded whenever they are asked for.

        Raises:
            SlamError: the file cannot be written; what was kept before can still be read.
        """
        contents = self._color(frame.rgb), self._depth(frame.depth_m)
        if (size := sum(map(len, contents))) <= self._left:
            self._left -= size
            return _KeptFrame(
                frame, self._depth_scale, *(partial(_same, each) for each in contents)
            )
        self._left = 0  # what comes later goes to the file, too
        try:
            self._file = self._file or _NamelessFile(self._folder)
            reads = [self._file.append(each) for each in contents]
        except OSError as error:
            raise SlamError(
                f"cannot keep the images of keyframes: {error.strerror}; free the space, or let"
                " more of them stay in memory with --keyframes.memory-mb:"
                f" {self._folder or tempfile.gettempdir()}"
            ) from error
        return _KeptFrame(frame, self._depth_scale, *reads)

    def _color(self, rgb: NDArray[np.uint8]) -> bytes:
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()

    def _depth(self, depth_m: NDArray[np.float32]) -> bytes:
        """Return depth in whole units where it was measured in these, else as it is."""
        with np.errstate(invalid="ignore", over="ignore"):
            units = np.rint(depth_m * self._depth_scale).astype(np.uint16)
        is_whole = np.array_equal(units / self._depth_scale, depth_m)
        return zlib.compress((units if is_whole else depth_m).tobytes(), _ZLIB_LEVEL)


class _KeptFrame(Frame):
    """A frame whose images are decoded anew whenever they are asked for."""

    def __init__(
        self,
        frame: Frame,
        depth_scale: np.float32,
        read_color: Callable[[], bytes],
        read_depth: Callable[[], bytes],
    ) -> None:
        object.__setattr__(self, "timestamp_s", frame.timestamp_s)
        self._shape = frame.depth_m.shape
        self._depth_scale = depth_scale
        self._read_color, self._read_depth = read_color, read_depth

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8, as a JPEG shows it."""
        bgr = cv2.imdecode(np.frombuffer(self._read_color(), np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB, dst=bgr), np.uint8)

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) float32, metres along the optical axis, 0 where unknown."""
        content = zlib.decompress(self._read_depth())
        if len(content) == 2 * math.prod(self._shape):
            units = np.frombuffer(content, np.uint16).reshape(self._shape)
            return np.asarray(units / self._depth_scale, np.float32)
        return np.frombuffer(content, np.float32).reshape(self._shape).copy()

    def __reduce__(self) -> tuple[type[Frame], tuple[object, ...]]:
        # A copy, also one for another process, is a frame like any other.
        return Frame, (self.timestamp_s, self.rgb, self.depth_m)


def _same(content: bytes) -> bytes:
    return content


class _NamelessFile:
    """A file that only grows, and is gone as soon as nobody holds it, however a program ends."""

    def __init__(self, folder: Path | None) -> None:
        self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        self._size = 0

    def append(self, content: bytes) -> Callable[[], bytes]:
        """Write at the end, and return what reads it again."""
        start, size, left = self._size, len(content), memoryview(content)
        while left:
            written = os.pwrite(self._file.fileno(), left, start + size - len(left))
            left = left[written:]
        self._size += size
        return lambda: os.pread(self._file.fileno(), size, start)

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            self._file.close()

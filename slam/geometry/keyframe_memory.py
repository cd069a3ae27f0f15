# SPDX-License-Identifier: Apache-2.0
"""What is kept of keyframes, images compressed: in memory, and in a file where there are many."""

import math
import os
import tempfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.types import Features, Frame, SlamError

_JPEG_QUALITY = 90
_ZLIB_LEVEL = 1  # as a PNG of level 1, in two thirds of the time
_READ_LAST = 2  # keyframes that are compared: 65 kB each, whose arrays are asked for by turns

_Layout = tuple[tuple[np.dtype[Any], tuple[int, ...]], ...]


class KeyframeMemory:
    """Keeps small frames and features until the last of them is forgotten.

    Colour becomes a JPEG; all else is kept to the last bit. While one thread keeps, any may read.
    """

    def __init__(self, most_bytes: int, depth_scale: float, folder: Path | None = None) -> None:
        """Keep so many bytes in memory; the rest goes to a file without a name in a folder.

        The default is the system's folder of temporary files. Depth that is a whole number of units
        per metre, `depth_scale`, takes least.
        """
        self._left = most_bytes
        self._depth_scale = depth_scale
        self._folder = folder
        self._file: _NamelessFile | None = None
        self._read_features = lru_cache(_READ_LAST)(_features)

    def keep_image(self, frame: Frame) -> Frame:
        """Return the frame again, with images that are decoded whenever they are asked for.

        Raises:
            SlamError: the file cannot be written; what was kept before can still be read.
        """
        contents = compressed(frame, self._depth_scale)
        if self._has_room(sum(map(len, contents))):
            reads: list[Callable[[], bytes]] = [partial(_same, each) for each in contents]
        else:
            reads = [self._in_file(each) for each in contents]
        return _KeptFrame(frame.timestamp_s, frame.depth_m.shape, self._depth_scale, *reads)

    def keep_features(self, features: Features) -> Features:
        """Return the features again, with arrays that may be read anew when they are asked for.

        Where the file cannot be written, they stay in memory: their keyframe is in the map already.
        """
        arrays = [getattr(features, each.name) for each in fields(Features)]
        if self._has_room(sum(each.nbytes for each in arrays)):
            return features
        layout = tuple((each.dtype, each.shape) for each in arrays)
        with suppress(SlamError):
            read = self._in_file(b"".join(each.tobytes() for each in arrays))
            return _KeptFeatures.read_by(partial(self._read_features, read, layout))
        return features

    def _has_room(self, size: int) -> bool:
        """Take so many bytes of memory if they are left; else what comes later finds none, too."""
        has_room = size <= self._left
        self._left = self._left - size if has_room else 0
        return has_room

    def _in_file(self, content: bytes) -> Callable[[], bytes]:
        try:
            self._file = self._file or _NamelessFile(self._folder)
            return self._file.append(content)
        except OSError as error:
            raise SlamError(
                f"cannot keep what keyframes show: {error.strerror}; free the space, or let"
                " more of them stay in memory with --keyframes.memory-mb:"
                f" {self._folder or tempfile.gettempdir()}"
            ) from error


def compressed(frame: Frame, depth_scale: float) -> tuple[bytes, bytes]:
    """Return what a small frame is kept as: a JPEG of its colour, and its depth, deflated.

    Depth is (H, W) uint16 in whole units where it was measured in these, else float32 metres.
    """
    if isinstance(frame, _KeptFrame):
        return frame.contents
    bgr = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
    color = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
    scale = np.float32(depth_scale)
    with np.errstate(invalid="ignore", over="ignore"):
        units = np.rint(frame.depth_m * scale).astype(np.uint16)
    is_whole = np.array_equal(units / scale, frame.depth_m)
    depth = zlib.compress((units if is_whole else frame.depth_m).tobytes(), _ZLIB_LEVEL)
    return color, depth


def kept_frame(
    timestamp_s: float,
    shape: tuple[int, int],
    depth_scale: float,
    color: NDArray[np.uint8],
    depth: NDArray[np.uint8],
) -> Frame:
    """Return the frame of (H, W) pixels whose `compressed` bytes are given, wherever they lie."""
    return _KeptFrame(timestamp_s, shape, depth_scale, color.tobytes, depth.tobytes)


def full_size(rgb: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a small image enlarged to (H, W) pixels; what was averaged away stays away."""
    height, width = shape
    enlarged = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(enlarged, np.uint8)


class _KeptFrame(Frame):
    """A frame whose images are decoded anew whenever they are asked for."""

    def __init__(
        self,
        timestamp_s: float,
        shape: tuple[int, ...],
        depth_scale: float,
        read_color: Callable[[], bytes],
        read_depth: Callable[[], bytes],
    ) -> None:
        object.__setattr__(self, "timestamp_s", timestamp_s)
        self._shape = shape
        self._depth_scale = np.float32(depth_scale)
        self._read_color, self._read_depth = read_color, read_depth

    @property
    def contents(self) -> tuple[bytes, bytes]:
        """What it is kept as, see `compressed`."""
        return self._read_color(), self._read_depth()

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


class _KeptFeatures(Features):
    """Features that are read anew when they are asked for, unless they were just read."""

    _read: Callable[[], Features]

    @classmethod
    def read_by(cls, read: Callable[[], Features]) -> "_KeptFeatures":
        """Return features without any array; one that `dataclasses.replace` makes has all."""
        features = cls.__new__(cls)
        features._read = read
        return features

    def __getattr__(self, name: str) -> NDArray[Any]:
        # Python asks here for what it finds nowhere else.
        if name not in self.__dataclass_fields__:
            raise AttributeError(name)
        array: NDArray[Any] = getattr(self._read(), name)
        return array

    def __reduce__(self) -> tuple[type[Features], tuple[object, ...]]:
        # A copy, also one for another process, is like any other.
        return Features, tuple(getattr(self, each.name) for each in fields(Features))


def _features(read: Callable[[], bytes], layout: _Layout) -> Features:
    content, start, arrays = read(), 0, []
    for dtype, shape in layout:
        array: NDArray[Any] = np.ndarray(shape, dtype, content, start)
        arrays.append(array.copy())  # aligned and to be written to, as loops are compiled for
        start += array.nbytes
    return Features(*arrays)


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

# SPDX-License-Identifier: Apache-2.0
"""The frames of a video file by number."""

import threading
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage
from placerec.files import check_file
from slam.types import SlamError

_RECENT = 8  # more than threads that ask for neighbouring frames can be apart
_NEAR = 30  # decoding so many frames takes no longer than looking for one

_MOST_BYTES = 1 << 40
_ENDS = "the video ends before, or is damaged"


class Video:
    """A video whose frames are decoded once when asked for in order, from any thread.

    Of those asked for in order each is the one of its number. Others are looked for by OpenCV,
    which reckons with a constant frame rate.

    Attributes:
        path: the file.
        count: frames, as the file says.
        width, height: size of the frames as they were recorded, pixels.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            SlamError: it cannot be opened, or says that it holds no frame.
        """
        check_file(path, _MOST_BYTES, kind=SlamError)
        self.path = path
        self._capture = self._opened()
        self.count = round(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.width = round(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = round(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if self.count < 1:
            raise SlamError(f"the video holds no frame: {path}")
        self._next = 0
        self._recent: dict[int, NDArray[np.uint8] | BrokenImage] = {}
        self._lock = threading.Lock()

    def frame(self, i: int) -> NDArray[np.uint8] | BrokenImage:
        """Return frame `i`, counted from 0, as (H, W, 3) uint8 RGB."""
        if i >= self.count:
            return BrokenImage(self.path / f"{i:06d}", _ENDS)
        with self._lock:
            if i not in self._recent and not self._next <= i < self._next + _NEAR:
                if i >= _NEAR:
                    return self._found(i)
                self._capture, self._next, self._recent = self._opened(), 0, {}
            while self._next <= i:
                self._recent[self._next] = self._read(self._capture, self._next)
                self._recent.pop(self._next - _RECENT, None)
                self._next += 1
            return self._recent[i]

    def _opened(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise SlamError(f"the video cannot be opened, or its kind is not known: {self.path}")
        # Turning frames as the file asks would tear them away from their depth images.
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return capture

    def _found(self, i: int) -> NDArray[np.uint8] | BrokenImage:
        capture = self._opened()
        capture.set(cv2.CAP_PROP_POS_FRAMES, i)
        return self._read(capture, i)

    def _read(self, capture: cv2.VideoCapture, i: int) -> NDArray[np.uint8] | BrokenImage:
        is_read, image = capture.read()
        if not is_read:
            return BrokenImage(self.path / f"{i:06d}", _ENDS)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)

# SPDX-License-Identifier: Apache-2.0
"""A recording on disk, whatever its format: frames in the order of time, read ahead."""

from collections import deque
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Items
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage
from placerec.datasets.times import in_order
from placerec.files import is_file
from slam.datasets.images import color_bits, depth_units, read_color, read_depth
from slam.datasets.plausibility import doubts_about_depth, doubts_about_intrinsics
from slam.datasets.registration import Registration
from slam.types import Camera, FloatArray, Frame, SlamError, Trajectory

_READERS = 2
_FRAMES_AHEAD = 4
_SAMPLES = 4
_SAMPLES_16 = 16  # of colour images, to see how bright they get

ColorReader = Callable[[Path], NDArray[np.uint8] | BrokenImage]
"""Returns a colour image as (H, W, 3) uint8 RGB."""

DepthReader = Callable[[Path], NDArray[np.float32] | BrokenImage]
"""Returns a depth image as (H, W) float32, metres, 0 where unknown."""


@dataclass(frozen=True)
class ImagePair:
    """The two files of one frame; the time is the colour image's, seconds.

    A frame of a video is a path as if the video were a folder: rgb.mp4/000012.
    """

    timestamp_s: float
    color_path: Path
    depth_path: Path


def pairs_in_order(
    pairs: list[ImagePair], file: Path, warnings: list[str]
) -> tuple[list[ImagePair], FloatArray]:
    """Return pairs of images in the order of time, and the ends of sessions, seconds.

    Where the clock of the file that tells the times starts again, what follows is moved behind.

    Raises:
        LoopcloseError: too many times are equal.
    """
    stamps_s = np.array([pair.timestamp_s for pair in pairs])
    kept, times_s, clock = in_order(stamps_s, file, warnings)
    ordered = zip(kept, times_s.tolist(), strict=True)
    return [replace(pairs[i], timestamp_s=time_s) for i, time_s in ordered], clock.ends_s


class Sequence:
    """An RGB-D recording whose frames are decoded in the background while others are worked on.

    Frames whose images are missing or broken are left out and listed in `skipped`.

    Attributes:
        name: short name, for people.
        camera: the camera of its frames.
        timestamps_s: (N,) float64, strictly increasing, the frames whose files exist.
        ground_truth: true camera poses, or None where there are none.
    """

    def __init__(
        self,
        name: str,
        camera: Camera,
        images: list[ImagePair],
        *,
        ground_truth: Trajectory | None = None,
        warnings: tuple[str, ...] = (),
        registration: Registration | None = None,
        read_color_file: ColorReader | None = None,
        read_depth_file: DepthReader | None = None,
        images_are_files: bool = True,
        session_ends_s: Items[float] | FloatArray = (),
    ) -> None:
        """Look at which files exist, and at a few of them for signs of wrong settings.

        Colour and depth files that do not show the same pixel by pixel need a `registration`,
        colour files that are no images a `read_color_file`, and depth files that are neither images
        in the camera's depth scale nor of floating-point metres a `read_depth_file`. Any thread may
        call those. Where `images_are_files` is false, paths are only names, which those functions
        know. Where `session_ends_s` names times, it is several recordings, one after the other.

        Raises:
            SlamError: more than half of the frames miss a file, or the images do not fit together.
        """
        self.name = name
        self.ground_truth = ground_truth
        self._registration = registration
        self._listed = len(images)
        self._session_ends_s = session_ends_s
        self._skipped: dict[float, BrokenImage] = {}
        self._images = [pair for pair in images if not images_are_files or self._exists(pair)]
        self.timestamps_s: FloatArray = np.array([pair.timestamp_s for pair in self._images])
        bits = 8 if read_color_file else color_bits([p.color_path for p in self._some(_SAMPLES_16)])
        self._read_color = read_color_file or partial(read_color, bits=bits)
        units = camera.depth_scale
        if read_depth_file is None:
            units = depth_units((p.depth_path for p in self._some(_SAMPLES)), units)
        self.camera = replace(camera, depth_scale=units)
        self._read_depth = read_depth_file or partial(read_depth, depth_scale=units)
        self._warnings = [*warnings, *doubts_about_intrinsics(camera), *self._doubts_about_depth()]
        if 8 < bits < 16:
            self._warnings.append(f"the colour images use {bits} of their 16 bits")
        if units != camera.depth_scale:
            self._warnings.append(
                "the depth images hold floating-point numbers and are taken to be in metres,"
                f" whatever the depth scale ({camera.depth_scale:g})"
            )

    def __len__(self) -> int:
        return len(self._images)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the readable frames in the order of time.

        Raises:
            SlamError: more than half of the frames are broken, or an image is of the wrong kind.
        """
        for pair, frame in zip(self._images, self._read_ahead(), strict=True):
            if isinstance(frame, BrokenImage):
                self._skip(pair, frame)
            else:
                yield frame

    def frame(self, i: int) -> Frame:
        """Return the frame of `timestamps_s[i]`.

        Raises:
            SlamError: one of its images is broken or of the wrong kind.
        """
        frame = self._read(self._images[i])
        if isinstance(frame, BrokenImage):
            raise SlamError(f"frame {i} cannot be read: {frame.why}: {frame.path}")
        return frame

    @property
    def skipped(self) -> list[BrokenImage]:
        """The (path, why) of each frame left out so far, in the order of time."""
        return [self._skipped[timestamp_s] for timestamp_s in sorted(self._skipped)]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know before trusting a run; one sentence each, skipped so far too."""
        if not self._skipped:
            return tuple(self._warnings)
        path, why = self.skipped[0]
        return (
            *self._warnings,
            f"{len(self._skipped)} of {self._listed} frames were skipped because an image is"
            f" missing or broken; the first: {why}: {path}",
        )

    def sessions(self) -> "list[Sequence]":
        """Return the recordings that this one consists of; most are one.

        They follow one another in time, and have the truth in common; the first has the warnings.
        """
        cuts = np.searchsorted(self.timestamps_s, self._session_ends_s)
        starts, ends = [0, *cuts.tolist()], [*cuts.tolist(), len(self)]
        bounds = [(start, end) for start, end in zip(starts, ends, strict=True) if start < end]
        if len(bounds) < 2:
            return [self]
        return [self._part(k, start, end) for k, (start, end) in enumerate(bounds, start=1)]

    def _part(self, number: int, start: int, end: int) -> "Sequence":
        part = copy(self)
        part.name = f"{self.name}, session {number}"
        part.timestamps_s = self.timestamps_s[start:end]
        part._images = self._images[start:end]
        part._listed = end - start
        part._skipped = self._skipped if number == 1 else {}
        part._warnings = self._warnings if number == 1 else []
        return part

    def _exists(self, pair: ImagePair) -> bool:
        for path in (pair.color_path, pair.depth_path):
            if not (is_file(path) or is_file(path.parent)):  # the latter is a video
                self._skip(pair, BrokenImage(path, "the file is missing"))
                return False
        return True

    def _skip(self, pair: ImagePair, broken: BrokenImage) -> None:
        self._skipped[pair.timestamp_s] = broken
        if 2 * len(self._skipped) > self._listed:
            raise SlamError(
                f"more than half of the {self._listed} frames have a missing or broken image; was"
                f" the sequence unpacked completely? the last: {broken.why}: {broken.path}"
            )

    def _some(self, count: int) -> list[ImagePair]:
        """Return about so many pairs, spread over the recording."""
        spread = np.linspace(0, len(self) - 1, count).astype(int)
        return [self._images[i] for i in sorted(set(spread.tolist())) if i >= 0]

    def _doubts_about_depth(self) -> list[str]:
        frames = [self._read(pair) for pair in self._some(_SAMPLES)]
        depths_m = [frame.depth_m for frame in frames if isinstance(frame, Frame)]
        return doubts_about_depth(depths_m, self.camera.depth_scale)

    def _read(self, pair: ImagePair) -> Frame | BrokenImage:
        rgb = self._read_color(pair.color_path)
        if isinstance(rgb, BrokenImage):
            return rgb
        color_camera = self._registration.color_camera if self._registration else self.camera
        if rgb.shape[:2] != (color_camera.height, color_camera.width):
            raise SlamError(
                f"a colour image has {rgb.shape[1]}x{rgb.shape[0]} pixels but the camera"
                f" {color_camera.width}x{color_camera.height}; give the camera that made it with"
                f" --input.camera FILE.toml: {pair.color_path}"
            )
        depth_m = self._read_depth(pair.depth_path)
        if isinstance(depth_m, BrokenImage):
            return depth_m
        if depth_m.shape != (self.camera.height, self.camera.width):
            raise SlamError(self._wrong_depth(depth_m.shape, pair.depth_path))
        if self._registration:
            rgb = self._registration.register_color(rgb)
            depth_m = self._registration.register_depth(depth_m)
        return Frame(pair.timestamp_s, rgb, depth_m)

    def _wrong_depth(self, shape: tuple[int, ...], path: Path) -> str:
        size, wanted = f"{shape[1]}x{shape[0]}", f"{self.camera.width}x{self.camera.height}"
        if self._registration:
            return f"a depth image has {size} pixels but the depth camera {wanted}: {path}"
        return (
            f"a depth image has {size} pixels but its colour image {wanted}; depth must be"
            f" registered to colour, pixel by pixel: {path}"
        )

    def _read_ahead(self) -> Iterator[Frame | BrokenImage]:
        readers = ThreadPoolExecutor(_READERS, thread_name_prefix="images")
        pending: deque[Future[Frame | BrokenImage]] = deque()
        try:
            for pair in self._images:
                pending.append(readers.submit(self._read, pair))
                if len(pending) > _FRAMES_AHEAD:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            # Runs too when the loop over frames is left early or interrupted.
            readers.shutdown(cancel_futures=True)

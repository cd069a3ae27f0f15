# SPDX-License-Identifier: Apache-2.0
"""Depth image files of any kind, decoded; a broken file is an answer, not an exception."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage, content_of, decode_content
from placerec.files import array_of
from slam.datasets.images.exr import EXR_MAGIC, decode_exr
from slam.types import SlamError

_NO_DEPTH = np.iinfo(np.uint16).max  # some sensors' drivers write it instead of 0
_MOST_M = 50.0  # no camera indoors measures more: floating-point depth beyond is in other units
_NUMPY_MAGIC = b"\x93NUMPY"


def read_depth(path: Path, depth_scale: float) -> NDArray[np.float32] | BrokenImage:
    """Return a depth image as (H, W) float32, metres, 0 where unknown (0 or 65535 in it).

    It may be any image of one channel, or an array of NumPy, of more than 8 bits.

    Raises:
        SlamError: the image is not of the kind that holds depth.
    """
    image = _read_units(path)
    if isinstance(image, BrokenImage):
        return image
    if not _holds_depth(image):
        channels = 1 if image.ndim == 2 else image.shape[-1]
        raise SlamError(
            f"a depth image has {channels} channel(s) of {image.dtype}; it must have one channel"
            f" of 16 bits (uint16, {depth_scale:g} units per metre) or of floating point: {path}"
        )
    if image.dtype == np.uint16:
        return in_metres(image, depth_scale)
    depth_m = image.astype(np.float32) / np.float32(depth_scale)
    return np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.float32(0.0))


def depth_units(paths: Iterable[Path], depth_scale: float) -> float:
    """Return the units per metre of depth images: `depth_scale`, or 1 of floating-point metres."""
    images = (_read_units(path) for path in paths)
    image = next((each for each in images if not isinstance(each, BrokenImage)), None)
    if image is None or image.dtype.kind != "f":
        return depth_scale
    known = image[np.isfinite(image) & (image > 0.0)]
    return 1.0 if len(known) and np.median(known) <= _MOST_M else depth_scale


def _read_units(path: Path) -> NDArray[Any] | BrokenImage:
    """Return what a depth file holds, whatever its name says that it is."""
    content = content_of(path)
    if isinstance(content, BrokenImage):
        return content
    if content.startswith(EXR_MAGIC):
        return decode_exr(content, path)
    if content.startswith(_NUMPY_MAGIC):
        return _decode_array(content, path)
    return decode_content(content, path, cv2.IMREAD_UNCHANGED)


def _decode_array(content: bytes, path: Path) -> NDArray[Any] | BrokenImage:
    """Return the rows and columns of numbers that NumPy wrote into a file."""
    try:
        array = array_of(content)
    except ValueError:
        return BrokenImage(path, "the file is cut off, or no array")
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2 or array.dtype.kind not in "uif":
        return BrokenImage(path, "not an array of rows and columns of numbers")
    return np.asarray(array)


def _holds_depth(image: NDArray[Any]) -> bool:
    return image.ndim == 2 and image.dtype.itemsize > 1


def in_metres(image: NDArray[np.uint16], depth_scale: float) -> NDArray[np.float32]:
    """Return depth of so many units per metre, 0 or 65535 where unknown, in metres, 0 there."""
    depth_m = np.divide(image, np.float32(depth_scale), dtype=np.float32)
    if image.max(initial=0) == _NO_DEPTH:  # few cameras write it
        depth_m[image == _NO_DEPTH] = 0.0
    return depth_m


def is_depth(path: Path) -> bool:
    """Return whether a file is an image of the kind that holds depth: one channel of 16 bits."""
    image = _read_units(path)
    return not isinstance(image, BrokenImage) and _holds_depth(image)


def read_size(paths: Iterable[Path]) -> tuple[int, int]:
    """Return (width, height), pixels, of the first of the images that can be read.

    Raises:
        SlamError: none of them can.
    """
    broken = None
    for path in paths:
        image = _read_units(path)
        if not isinstance(image, BrokenImage):
            return image.shape[1], image.shape[0]
        broken = broken or image
    why = f"{broken.why}: {broken.path}" if broken else "there is none"
    raise SlamError(f"none of the images can be read; the first: {why}")

# SPDX-License-Identifier: Apache-2.0
"""Colour and depth image files, decoded; a broken file is an answer, not an exception."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage, decode
from placerec.datasets.times import FRAMES_PER_S as FRAMES_PER_S
from slam.types import SlamError

ANY_IMAGE = re.compile(r"\D*(\d+)(?:-\d+)?\.(?:png|jpe?g|bmp|ppm|tiff?)", re.IGNORECASE)

_MANY_UNPAIRED = 0.1


class NumberedPair(NamedTuple):
    """The images of one number; that of depth may be missing."""

    number: int
    color: Path
    depth: Path


def numbered_pairs(color: Path, depth: Path, warnings: list[str]) -> list[NumberedPair]:
    """Return the images of two folders, in the order of their numbers, a pair per colour image.

    Raises:
        SlamError: a folder has no image, or two of one number.
    """
    colors, depths = numbered_images(color), numbered_images(depth)
    unpaired = len(depths.keys() - colors.keys())
    if unpaired > _MANY_UNPAIRED * len(depths):
        warnings.append(
            f"{unpaired} of {len(depths)} depth images have no colour image of their number and"
            " are not used"
        )
    return [
        NumberedPair(number, path, depths.get(number, depth / f"{path.stem}.png"))
        for number, path in colors.items()
    ]


def numbered_images(folder: Path, name: re.Pattern[str] = ANY_IMAGE) -> dict[int, Path]:
    """Return the images of a folder by the number that the name's first group holds, in order.

    Raises:
        SlamError: there is none, or two have the same number.
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = name.fullmatch(path.name)
        if match is None:
            continue
        number = int(match[1])
        if number in found:
            raise SlamError(
                f"two images have the number {number}, {found[number].name} and {path.name};"
                f" remove one: {folder}"
            )
        found[number] = path
    if not found:
        raise SlamError(f"the folder holds no numbered image: {folder}")
    return dict(sorted(found.items()))


# Turning an image as its EXIF data asks would tear it away from its depth image.
COLOR_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION

_NO_DEPTH = np.iinfo(np.uint16).max  # some sensors' drivers write it instead of 0


def read_color(path: Path) -> NDArray[np.uint8] | BrokenImage:
    """Return a colour image as (H, W, 3) uint8 RGB; grey images get three equal channels."""
    image = decode(path, COLOR_FLAGS)
    if isinstance(image, BrokenImage):
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth(path: Path, depth_scale: float) -> NDArray[np.float32] | BrokenImage:
    """Return a depth image as (H, W) float32, metres, 0 where unknown (0 or 65535 in it).

    Raises:
        SlamError: the image is not of the kind that holds depth.
    """
    image = decode(path, cv2.IMREAD_UNCHANGED)
    if isinstance(image, BrokenImage):
        return image
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise SlamError(
            f"a depth image has {channels} channel(s) of {image.dtype}; it must have one channel"
            f" of 16 bits (uint16, {depth_scale:g} units per metre): {path}"
        )
    return in_metres(image.astype(np.uint16, copy=False), depth_scale)


def in_metres(image: NDArray[np.uint16], depth_scale: float) -> NDArray[np.float32]:
    """Return depth of so many units per metre, 0 or 65535 where unknown, in metres, 0 there."""
    known = np.where(image == _NO_DEPTH, np.uint16(0), image)
    return known.astype(np.float32) / np.float32(depth_scale)


def is_depth(path: Path) -> bool:
    """Return whether a file is an image of the kind that holds depth: one channel of 16 bits."""
    image = decode(path, cv2.IMREAD_UNCHANGED)
    return not isinstance(image, BrokenImage) and image.dtype == np.uint16 and image.ndim == 2


def read_size(paths: Iterable[Path]) -> tuple[int, int]:
    """Return (width, height), pixels, of the first of the images that can be read.

    Raises:
        SlamError: none of them can.
    """
    broken = None
    for path in paths:
        image = decode(path, cv2.IMREAD_UNCHANGED)
        if not isinstance(image, BrokenImage):
            return image.shape[1], image.shape[0]
        broken = broken or image
    why = f"{broken.why}: {broken.path}" if broken else "there is none"
    raise SlamError(f"none of the images can be read; the first: {why}")

# SPDX-License-Identifier: Apache-2.0
"""Colour and depth images from the messages that ROS sends them in.

Depth is as REP 118 has it: 16 bits are millimetres, unless told otherwise, and floats are metres.
"""

import struct
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage, decode_content
from slam.datasets.images import COLOR_FLAGS, in_metres
from slam.types import SlamError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

Kind = Literal["colour", "depth"]
READABLE: dict[Kind, str] = {
    "colour": "rgb8, bgr8, rgba8, bgra8, mono8, jpeg or png",
    "depth": "16UC1, 32FC1, mono16, png of 16 bits or compressedDepth",
}

_TO_RGB = {
    "rgb8": None,
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
}
_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_METRES = "32FC1"
_DEPTH_TYPES = {"16UC1": np.uint16, "mono16": np.uint16, _METRES: np.float32}
_COMPRESSED_DEPTH = "compressedDepth"
_DEPTH_HEADER = struct.Struct("<iff")  # kind of quantisation, and its two parameters
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_PNG_KIND, _GREY_OF_16_BITS = slice(24, 26), bytes([16, 0])


def encoding_of(message: Any) -> str:
    """Return what a message says that its image is in, in the words of ROS."""
    return str(message.encoding if _is_raw(message) else message.format)


def is_in_metres(message: Any) -> bool:
    """Return whether a message's depth is in metres, not in units that a scale tells."""
    return _pixel_type(message) == _METRES


def is_grey(message: Any) -> bool:
    """Return whether a message says that its image is grey, as many that are not colour do."""
    return _pixel_type(message) == "mono8"


def kind_of(message: Any) -> Kind | None:
    """Return which kind of image a message holds; None where it is neither or not readable."""
    kind = _pixel_type(message)
    if _is_raw(message):
        return "colour" if kind in _TO_RGB else "depth" if kind in _DEPTH_TYPES else None
    start = bytes(message.data[:32])
    if _COMPRESSED_DEPTH in message.format or kind in _DEPTH_TYPES:
        return "depth"
    if start.startswith(_PNG):
        return "depth" if start[_PNG_KIND] == _GREY_OF_16_BITS else "colour"
    return "colour" if start.startswith(_JPEG) else None


def color_image(message: Any, path: Path) -> NDArray[np.uint8] | BrokenImage:
    """Return a message's image as (H, W, 3) uint8 RGB; `path` is the message's name.

    Raises:
        SlamError: the message is not of a kind that holds colour.
    """
    if _is_raw(message) or kind_of(message) == "depth":
        _check_kind(message, "colour", path)
    if not _is_raw(message):
        image = decode_content(bytes(message.data), path, COLOR_FLAGS)
        if isinstance(image, BrokenImage):
            return image
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    pixels = _pixels(message, np.dtype(np.uint8), _CHANNELS.get(message.encoding, 1), path)
    conversion = _TO_RGB[message.encoding]
    if isinstance(pixels, BrokenImage) or conversion is None:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)


def depth_image(message: Any, path: Path, depth_scale: float) -> NDArray[np.float32] | BrokenImage:
    """Return a message's image as (H, W) float32, metres, 0 where unknown.

    Raises:
        SlamError: the message is not of a kind that holds depth.
    """
    _check_kind(message, "depth", path)
    if not _is_raw(message):
        return _compressed_depth(message, path, depth_scale)
    kind = np.dtype(_DEPTH_TYPES[message.encoding])
    pixels = _pixels(message, kind, 1, path)
    if isinstance(pixels, BrokenImage):
        return pixels
    return _known(pixels) if message.encoding == _METRES else in_metres(pixels, depth_scale)


def _is_raw(message: Any) -> bool:
    return hasattr(message, "encoding")


def _pixel_type(message: Any) -> str:
    """Return the encoding before compression, as far as the message tells."""
    return encoding_of(message).split(";")[0].strip()


def _check_kind(message: Any, kind: Kind, path: Path) -> None:
    if kind_of(message) != kind:
        raise SlamError(
            f"an image has the encoding {encoding_of(message)!r}; {kind} is read from"
            f" {READABLE[kind]}: {path}"
        )


def _pixels(message: Any, kind: np.dtype[Any], channels: int, path: Path) -> Any | BrokenImage:
    """Return the (H, W) or (H, W, channels) pixels of an image that is not compressed."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * kind.itemsize
    if not row or not height or step < row or len(message.data) < height * step:
        return BrokenImage(
            path,
            f"{len(message.data)} bytes, {step} to a row, are not the {width}x{height} pixels of"
            f" {message.encoding} that they should be",
        )
    rows = np.asarray(message.data[: height * step], dtype=np.uint8).reshape(height, step)
    ordered = kind.newbyteorder(">" if message.is_bigendian else "<")
    pixels = np.ascontiguousarray(rows[:, :row]).view(ordered).astype(kind)
    return pixels.reshape(height, width, channels) if channels > 1 else pixels


def _compressed_depth(
    message: Any, path: Path, depth_scale: float
) -> NDArray[np.float32] | BrokenImage:
    content = bytes(message.data)
    header = b""
    if _COMPRESSED_DEPTH in message.format:
        header, content = content[: _DEPTH_HEADER.size], content[_DEPTH_HEADER.size :]
        if "rvl" in message.format:
            raise SlamError(f"depth compressed as rvl is not read, only as png: {path}")
    image = decode_content(content, path, cv2.IMREAD_UNCHANGED)
    if isinstance(image, BrokenImage):
        return image
    if image.dtype != np.uint16 or image.ndim != 2:
        return BrokenImage(path, "the compressed depth image is not one channel of 16 bits")
    if not header or _pixel_type(message) != _METRES:
        return in_metres(image.astype(np.uint16), depth_scale)
    _, a, b = _DEPTH_HEADER.unpack(header)
    with np.errstate(divide="ignore"):
        inverse = np.float32(a) / (image.astype(np.float32) - np.float32(b))
    return _known(np.where(image > 0, inverse, np.float32(0.0)))


def _known(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return depth with 0 in the place of what is no distance in front of the camera."""
    return np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.float32(0.0))

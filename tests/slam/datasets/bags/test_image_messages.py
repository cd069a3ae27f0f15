# SPDX-License-Identifier: Apache-2.0
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.bags.image_messages import color_image, depth_image, is_grey, kind_of
from slam.types import SlamError

PATH = Path("a.bag/camera/1.5")
RGB = np.random.default_rng(0).integers(0, 256, (6, 5, 3), np.uint8)
OPAQUE = np.full((6, 5, 1), 255, np.uint8)
DEPTH = np.array([[0, 65535, 500], [1000, 1234, 9999]], np.uint16)
METRES = np.array([[0.0, 0.0, 0.5], [1.0, 1.234, 9.999]], np.float32)


@pytest.fixture(params=["ros1", "ros2"])
def bags(request: pytest.FixtureRequest, recorder: Callable[..., Any]) -> Any:
    return recorder(request.param)


@pytest.mark.parametrize(
    ("pixels", "encoding"),
    [
        (RGB, "rgb8"),
        (RGB[..., ::-1], "bgr8"),
        (np.concatenate([RGB, OPAQUE], axis=2), "rgba8"),
        (np.concatenate([RGB[..., ::-1], OPAQUE], axis=2), "bgra8"),
    ],
)
def test_colour_comes_as_rgb(bags: Any, pixels: np.ndarray, encoding: str) -> None:
    message = bags.image(pixels, encoding)
    assert kind_of(message) == "colour" and not is_grey(message)
    rgb = color_image(message, PATH)
    assert isinstance(rgb, np.ndarray) and rgb.dtype == np.uint8
    np.testing.assert_array_equal(rgb, RGB)


def test_grey_has_three_equal_channels(bags: Any) -> None:
    message = bags.image(RGB[..., 0], "mono8")
    assert kind_of(message) == "colour" and is_grey(message)
    np.testing.assert_array_equal(color_image(message, PATH), np.repeat(RGB[..., :1], 3, axis=2))


@pytest.mark.parametrize("format_", ["png", "rgb8; png compressed bgr8"])
def test_colour_compressed_without_loss_is_the_same(bags: Any, format_: str) -> None:
    message = bags.compressed(bags.encoded(RGB[..., ::-1]), format_)
    assert kind_of(message) == "colour"
    np.testing.assert_array_equal(color_image(message, PATH), RGB)


@pytest.mark.parametrize("format_", ["jpeg", "bgr8; jpeg compressed bgr8"])
def test_colour_compressed_as_jpeg_is_nearly_the_same(bags: Any, format_: str) -> None:
    pixels = np.full((16, 16, 3), (250, 100, 20), np.uint8)
    message = bags.compressed(bags.encoded(pixels[..., ::-1], ".jpg"), format_)
    assert kind_of(message) == "colour"
    rgb = color_image(message, PATH)
    assert isinstance(rgb, np.ndarray)
    np.testing.assert_allclose(rgb, pixels, atol=4)


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
def test_whole_numbers_are_depth_in_units_of_the_scale(bags: Any, encoding: str) -> None:
    message = bags.image(DEPTH, encoding)
    assert kind_of(message) == "depth"
    depth_m = depth_image(message, PATH, 1000.0)
    assert isinstance(depth_m, np.ndarray) and depth_m.dtype == np.float32
    np.testing.assert_array_equal(depth_m, METRES)
    np.testing.assert_array_equal(depth_image(message, PATH, 500.0), 2.0 * METRES)


def test_floats_are_metres_whatever_the_scale(bags: Any) -> None:
    values = np.array([[np.nan, np.inf, -1.0], [1.0, 1.234, 9.999]], np.float32)
    depth_m = depth_image(bags.image(values, "32FC1"), PATH, 5000.0)
    assert isinstance(depth_m, np.ndarray) and depth_m.dtype == np.float32
    expected = np.array([[0.0, 0.0, 0.0], [1.0, 1.234, 9.999]], np.float32)
    np.testing.assert_array_equal(depth_m, expected)


@pytest.mark.parametrize(("pixels", "encoding"), [(DEPTH, "16UC1"), (METRES, "32FC1")])
def test_rows_may_be_padded_and_bytes_turned(bags: Any, pixels: np.ndarray, encoding: str) -> None:
    turned = pixels.astype(pixels.dtype.newbyteorder(">"))
    rows = [np.frombuffer(row.tobytes() + b"\xff\xff\xff", np.uint8) for row in turned]
    message = bags.image(
        pixels, encoding, is_bigendian=1, step=len(rows[0]), data=np.concatenate(rows)
    )
    np.testing.assert_array_equal(depth_image(message, PATH, 1000.0), METRES)


@pytest.mark.parametrize(
    "format_", ["16UC1; compressedDepth", "16UC1; compressedDepth png", "compressedDepth"]
)
def test_compressed_depth_of_whole_numbers(bags: Any, format_: str) -> None:
    message = bags.compressed(bags.depth_header() + bags.encoded(DEPTH), format_)
    assert kind_of(message) == "depth"
    np.testing.assert_array_equal(depth_image(message, PATH, 1000.0), METRES)


def test_compressed_depth_of_floats_is_inverse(bags: Any) -> None:
    """As compressed_depth_image_transport makes it: a = z (z + 1), b = 1 - a / z_max."""
    a, b = np.float32(100.0 * 101.0), np.float32(1.0 - 100.0 * 101.0 / 10.0)
    depth_m = np.array([[0.4, 1.0, 2.0], [5.0, 9.9, np.nan]], np.float32)
    known = np.isfinite(depth_m)
    inverse = np.where(known, a / np.where(known, depth_m, 1.0) + b, 0).astype(np.uint16)
    content = bags.depth_header(a, b) + bags.encoded(inverse)
    message = bags.compressed(content, "32FC1; compressedDepth png")
    assert kind_of(message) == "depth"
    found = depth_image(message, PATH, 5000.0)
    assert isinstance(found, np.ndarray) and found.dtype == np.float32
    np.testing.assert_allclose(found, np.where(known, depth_m, 0.0), rtol=1e-2)
    assert found[1, 2] == 0.0


@pytest.mark.parametrize("format_", ["16UC1; png compressed ", "png"])
def test_a_png_of_16_bits_is_depth(bags: Any, format_: str) -> None:
    message = bags.compressed(bags.encoded(DEPTH), format_)
    assert kind_of(message) == "depth"
    np.testing.assert_array_equal(depth_image(message, PATH, 1000.0), METRES)


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "yuv422", "64FC1", "16UC3", ""])
def test_other_encodings_are_neither(bags: Any, encoding: str) -> None:
    message = bags.image(RGB, encoding)
    assert kind_of(message) is None
    for read, kind in ((color_image, "colour"), (depth_image, "depth")):
        said = f"an image has the encoding {encoding!r}; {kind} is read from"
        with pytest.raises(SlamError, match=re.escape(said)) as caught:
            read(message, PATH, *([1000.0] if kind == "depth" else []))
        assert str(caught.value).endswith(str(PATH))


def test_depth_is_no_colour_and_colour_no_depth(bags: Any) -> None:
    for message in (bags.image(DEPTH, "16UC1"), bags.compressed(bags.encoded(DEPTH), "png")):
        with pytest.raises(SlamError, match="colour is read from rgb8"):
            color_image(message, PATH)
    for message in (bags.image(RGB, "rgb8"), bags.compressed(bags.encoded(RGB), "png")):
        with pytest.raises(SlamError, match="depth is read from 16UC1"):
            depth_image(message, PATH, 1000.0)


def test_other_compressions_are_neither(bags: Any) -> None:
    assert kind_of(bags.compressed(b"\0\0\0\1video", "h264")) is None
    rvl = bags.compressed(bags.depth_header() + b"\1\2\3", "16UC1; compressedDepth rvl")
    with pytest.raises(SlamError, match="rvl"):
        depth_image(rvl, PATH, 1000.0)


@pytest.mark.parametrize(
    "fields", [{"data": np.zeros(10, np.uint8)}, {"step": 2}, {"width": 0}, {"height": 9000}]
)
def test_a_message_that_is_cut_off_is_an_answer(bags: Any, fields: dict[str, Any]) -> None:
    for read in (
        color_image(bags.image(RGB, "rgb8", **fields), PATH),
        depth_image(bags.image(DEPTH, "16UC1", **fields), PATH, 1000.0),
    ):
        assert isinstance(read, BrokenImage)
        assert read.path == PATH and "should be" in read.why


def test_a_compressed_image_that_is_broken_is_an_answer(bags: Any) -> None:
    whole = bags.encoded(np.tile(RGB, (9, 9, 1)))
    assert color_image(bags.compressed(whole[:-20], "png"), PATH) == BrokenImage(
        PATH, "the file is cut off"
    )
    broken = bags.compressed(bags.depth_header() + b"nothing like it", "16UC1; compressedDepth")
    assert isinstance(depth_image(broken, PATH, 1000.0), BrokenImage)
    grey = bags.compressed(
        bags.depth_header() + bags.encoded(RGB[..., 0]), "16UC1; compressedDepth"
    )
    assert depth_image(grey, PATH, 1000.0) == BrokenImage(
        PATH, "the compressed depth image is not one channel of 16 bits"
    )

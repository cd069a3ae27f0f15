# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.images import is_depth, read_color, read_depth
from slam.types import SlamError

NOISE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 65536, (48, 64), dtype=np.uint16)


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1].tobytes())


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".webp", ".jpg", ".ppm"])
def test_colour_is_red_first_in_any_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"image{suffix}"
    path.write_bytes(encoded(suffix, np.full((24, 32, 3), (10, 20, 240), np.uint8)))
    rgb = read_color(path)
    assert not isinstance(rgb, BrokenImage)
    assert rgb.shape == (24, 32, 3)
    assert rgb.dtype == np.uint8
    np.testing.assert_allclose(rgb.reshape(-1, 3).mean(axis=0), [240, 20, 10], atol=4)


def test_grey_becomes_three_channels(tmp_path: Path) -> None:
    path = tmp_path / "grey.png"
    path.write_bytes(encoded(".png", NOISE[..., 0]))
    rgb = read_color(path)
    assert not isinstance(rgb, BrokenImage)
    assert (rgb == NOISE[..., :1]).all()


def test_depth_is_metres_with_zero_for_unknown(tmp_path: Path) -> None:
    path = tmp_path / "depth.png"
    path.write_bytes(encoded(".png", np.array([[0, 5000, 65534, 65535]], np.uint16)))
    depth_m = read_depth(path, 5000.0)
    assert not isinstance(depth_m, BrokenImage)
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, [[0.0, 1.0, 13.1068, 0.0]])


@pytest.mark.parametrize(
    ("image", "said"),
    [(NOISE, r"3 channel\(s\) of uint8"), (NOISE[..., 0], r"1 channel\(s\) of uint8")],
)
def test_an_image_that_cannot_be_depth_is_an_error(
    tmp_path: Path, image: np.ndarray, said: str
) -> None:
    path = tmp_path / "depth.png"
    path.write_bytes(encoded(".png", image))
    with pytest.raises(SlamError, match=said):
        read_depth(path, 5000.0)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("padding", [0, 512])
def test_a_cut_off_colour_image_is_broken(
    tmp_path: Path, suffix: str, share: float, padding: int
) -> None:
    content = encoded(suffix, NOISE)
    path = tmp_path / f"image{suffix}"
    path.write_bytes(content[: int(share * len(content))] + bytes(padding))
    broken = read_color(path)
    assert broken == BrokenImage(path, "the file is cut off")


@pytest.mark.parametrize("lost_bytes", [1, 12, 1000])
def test_a_cut_off_depth_image_is_broken(tmp_path: Path, lost_bytes: int) -> None:
    path = tmp_path / "depth.png"
    path.write_bytes(encoded(".png", DEPTH)[:-lost_bytes])
    broken = read_depth(path, 5000.0)
    # Of the end mark itself, its checksum alone may be lost: all pixels are there then.
    assert isinstance(broken, BrokenImage) or lost_bytes == 1


@pytest.mark.parametrize("content", [b"hello, this is text", b"\x89PNG\r\n\x1a\n junk IEND"])
def test_something_else_is_broken(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(content)
    assert read_color(path) == BrokenImage(path, "not a readable image")


def test_a_missing_image_is_broken(tmp_path: Path) -> None:
    assert read_color(tmp_path / "none.png") == BrokenImage(
        tmp_path / "none.png", "No such file or directory"
    )


def test_orientation_marks_do_not_turn_the_image(tmp_path: Path) -> None:
    # An EXIF block that says "turn by 90 degrees" behind the JPEG start mark.
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    block = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    content = encoded(".jpg", NOISE)
    path = tmp_path / "image.jpg"
    path.write_bytes(content[:2] + block + content[2:])
    turned = cv2.imread(str(path))
    assert turned is not None
    assert turned.shape == (64, 48, 3)  # the mark is understood
    rgb = read_color(path)
    assert not isinstance(rgb, BrokenImage)
    assert rgb.shape == (48, 64, 3)


def test_depth_is_told_by_its_kind(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    assert not is_depth(path)
    for image, answer in ((DEPTH, True), (NOISE, False), (NOISE[..., 0], False)):
        path.write_bytes(encoded(".png", image))
        assert is_depth(path) == answer
    path.write_bytes(encoded(".png", np.dstack([DEPTH] * 3)))
    assert not is_depth(path)

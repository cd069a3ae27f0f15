# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.images import color_bits, read_color

NOISE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)


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


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_of_16_bits_those_that_are_used_are_seen(tmp_path: Path, suffix: str, bits: int) -> None:
    paths = [tmp_path / f"{i}{suffix}" for i in range(4)]
    for path, share in zip(paths, (0.1, 0.3, 1.0, 0.2), strict=True):
        light = NOISE.astype(np.uint16) * (1 << (bits - 8)) * share
        path.write_bytes(encoded(suffix, light.astype(np.uint16)))
    assert color_bits(paths) == bits
    rgb = read_color(paths[2], bits)
    assert not isinstance(rgb, BrokenImage)
    assert np.abs(rgb[..., ::-1].astype(int) - NOISE).max() <= 1
    dark = read_color(paths[0], bits)
    assert not isinstance(dark, BrokenImage)
    assert dark.max() == 25


def test_what_is_brighter_than_any_that_was_looked_at_is_white(tmp_path: Path) -> None:
    path = tmp_path / "bright.png"
    path.write_bytes(encoded(".png", np.full((8, 8), 5000, np.uint16)))
    rgb = read_color(path, 12)
    assert not isinstance(rgb, BrokenImage)
    assert (rgb == 255).all()


def test_bits_are_those_of_the_images_that_can_be_read(tmp_path: Path) -> None:
    (tmp_path / "broken.png").write_bytes(b"no image")
    assert color_bits([tmp_path / "broken.png", tmp_path / "none.png"]) == 8
    (tmp_path / "eight.png").write_bytes(encoded(".png", NOISE))
    assert color_bits([tmp_path / "broken.png", tmp_path / "eight.png"]) == 8

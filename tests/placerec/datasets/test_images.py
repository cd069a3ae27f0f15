# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from placerec.datasets.images import (
    BrokenImage,
    decode,
    find_fault,
    images_in,
    natural_order,
    read_image,
)


def test_image_is_rgb(tmp_path):
    red = np.zeros((4, 6, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes blue, green, red
    cv2.imwrite(str(tmp_path / "red.png"), red)
    image = read_image(tmp_path / "red.png")
    assert image.shape == (4, 6, 3)
    assert image[0, 0].tolist() == [255, 0, 0]


@pytest.mark.parametrize("channels", [1, 4])
def test_grey_and_alpha_become_three_channels(tmp_path, write_image, channels):
    path = write_image(tmp_path / "odd.png", channels=channels)
    assert read_image(path).shape == (12, 16, 3)
    assert find_fault(path) is None


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("look", [read_image, find_fault])
def test_cut_off_file_is_broken(tmp_path, write_image, suffix, look):
    path = write_image(tmp_path / f"half{suffix}")
    path.write_bytes(path.read_bytes()[:-30])
    assert look(path) == BrokenImage(path, "the file is cut off")


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("compression", [0, 1, 9])
def test_images_of_16_bits_are_what_was_written(tmp_path, compression, channels):
    path, rng = tmp_path / "depth.png", np.random.default_rng(compression)
    rows = np.cumsum(rng.integers(0, 9, (37, 53, channels)), axis=1) * 300  # more than 8 bits
    image = np.squeeze(rows.astype(np.uint16))
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, compression])
    decoded = decode(path, cv2.IMREAD_UNCHANGED)
    assert decoded.dtype == np.uint16
    assert np.array_equal(decoded, image)


@pytest.mark.parametrize("place", [-20, -60, 60])
def test_depth_with_a_wrong_bit_is_broken(tmp_path, place):
    path = tmp_path / "depth.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 9999, (30, 40)).astype(np.uint16))
    content = bytearray(path.read_bytes())
    content[place] ^= 4
    path.write_bytes(content)
    assert decode(path, cv2.IMREAD_UNCHANGED) == BrokenImage(path, "not a readable image")


@pytest.mark.parametrize(
    ("content", "why"), [(b"", "cut off"), (b"<html>sorry</html>", "not a readable image")]
)
def test_file_that_is_no_image_is_broken(tmp_path, content, why):
    path = tmp_path / "page.jpg"
    path.write_bytes(content)
    assert why in find_fault(path).why


def test_missing_file_is_broken(tmp_path):
    assert find_fault(tmp_path / "gone.png").why == "No such file or directory"


def test_hidden_files_are_no_images_and_numbers_need_no_zeros(tmp_path, write_image):
    for i in (0, 1, 2, 10, 11, 100):
        write_image(tmp_path / f"{i}.jpg")
        (tmp_path / f"._{i}.jpg").write_bytes(b"of a Mac")
    (tmp_path / "3.jpg").mkdir()
    assert [int(path.stem) for path in images_in(tmp_path)] == [0, 1, 2, 10, 11, 100]


def test_names_that_are_times_are_in_their_order():
    names = ["a9.png", "a10.png", "b1.25.png", "b1.3.png", "b1.30.png", "b2.png", "c"]
    shuffled = [names[i] for i in (3, 6, 0, 5, 2, 1, 4)]
    assert sorted(shuffled, key=natural_order) == names


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_of_16_bits_those_that_are_used_are_seen(tmp_path, bits):
    light = np.arange(0, 256, dtype=np.uint16).reshape(16, 16) << (bits - 8)
    cv2.imwrite(str(tmp_path / "grey.png"), light)
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png")[..., 0], light >> (bits - 8))


def test_only_images_of_a_folder_by_name(tmp_path, write_image):
    for name in ("0010.jpg", "0002.JPG", "0001.png"):
        write_image(tmp_path / name)
    (tmp_path / "Thumbs.db").write_text("")
    assert [path.name for path in images_in(tmp_path)] == ["0001.png", "0002.JPG", "0010.jpg"]

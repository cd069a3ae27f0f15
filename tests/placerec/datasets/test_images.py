# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from placerec.datasets.images import BrokenImage, find_fault, images_in, read_image


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


@pytest.mark.parametrize(
    ("content", "why"), [(b"", "cut off"), (b"<html>sorry</html>", "not a readable image")]
)
def test_file_that_is_no_image_is_broken(tmp_path, content, why):
    path = tmp_path / "page.jpg"
    path.write_bytes(content)
    assert why in find_fault(path).why


def test_missing_file_is_broken(tmp_path):
    assert find_fault(tmp_path / "gone.png").why == "No such file or directory"


def test_only_images_of_a_folder_by_name(tmp_path, write_image):
    for name in ("0010.jpg", "0002.JPG", "0001.png"):
        write_image(tmp_path / name)
    (tmp_path / "Thumbs.db").write_text("")
    assert [path.name for path in images_in(tmp_path)] == ["0001.png", "0002.JPG", "0010.jpg"]

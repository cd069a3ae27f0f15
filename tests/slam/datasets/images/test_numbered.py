# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from slam.datasets.images import numbered_images, numbered_pairs
from slam.types import SlamError


def touch(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    "name",
    ["{}.png", "{:06d}.jpg", "frame-{}.PNG", "{:05d}-123.bmp", "cam0_{}.png", "2_{:03d}_l.png"],
)
def test_images_are_in_the_order_of_their_numbers(tmp_path: Path, name: str) -> None:
    names = [name.format(i) for i in (0, 2, 10, 100, 11)]
    hidden = [f"._{each}" for each in names]
    folder = touch(tmp_path, *names, *hidden, "Thumbs.db", ".DS_Store", "notes.txt", "desktop.ini")
    found = numbered_images(folder)
    assert list(found) == [0, 2, 10, 11, 100]
    assert [path.name for path in found.values()] == [name.format(i) for i in found]


def test_pictures_made_beside_the_images_do_not_count(tmp_path: Path) -> None:
    touch(tmp_path, "0001.png", "0001_shown.png", "0002.png", "overview.png")
    assert list(numbered_images(tmp_path)) == [1, 2]


@pytest.mark.parametrize("suffix", ["png", "npy", "exr", "pgm", "tiff", "TIF"])
def test_colour_and_depth_are_paired_by_number(tmp_path: Path, suffix: str) -> None:
    color = touch(tmp_path / "color", *(f"{i}.jpg" for i in (1, 2, 10)))
    depth = touch(tmp_path / "depth", *(f"{i:04d}.{suffix}" for i in (10, 2, 1)), "._0001.png")
    pairs = numbered_pairs(color, depth, [])
    assert [int(pair.color.stem) for pair in pairs] == [1, 2, 10]
    assert [int(pair.depth.stem) for pair in pairs] == [1, 2, 10]


def test_two_images_of_one_number_are_refused(tmp_path: Path) -> None:
    touch(tmp_path, "1.png", "01.png")
    with pytest.raises(SlamError, match=r"two images have the number 1, 01\.png and 1\.png"):
        numbered_images(tmp_path)


def test_a_folder_without_an_image_says_what_is_there(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="that is read here, but nothing"):
        numbered_images(tmp_path)
    touch(tmp_path, *(f"{i}.raw" for i in range(9)))
    with pytest.raises(SlamError, match=r"but 0\.raw, 1\.raw, 2\.raw: "):
        numbered_images(tmp_path)

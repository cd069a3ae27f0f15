# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.images.exr import read_exr
from slam.types import SlamError

SaveExr = Callable[..., None]
RNG = np.random.default_rng(0)
SMOOTH = np.linspace(0.5, 4.0, 37 * 25, dtype=np.float32).reshape(37, 25)
IMAGES = {
    "smooth": SMOOTH,
    "noise": RNG.random((37, 25), dtype=np.float32),
    "half": SMOOTH.astype(np.float16),
    "whole": RNG.integers(0, 5000, (37, 25)).astype(np.uint32),
}


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("compression", [0, 2, 3])
def test_numbers_are_read_as_they_were_written(
    tmp_path: Path, save_exr: SaveExr, name: str, compression: int
) -> None:
    save_exr(tmp_path / "a.exr", {"R": IMAGES[name]}, compression)
    image = read_exr(tmp_path / "a.exr")
    assert not isinstance(image, BrokenImage)
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image, IMAGES[name].astype(np.float32))


def test_zip_makes_the_smooth_image_smaller(tmp_path: Path, save_exr: SaveExr) -> None:
    save_exr(tmp_path / "plain.exr", {"R": SMOOTH}, 0)
    save_exr(tmp_path / "small.exr", {"R": SMOOTH}, 3)
    assert (tmp_path / "small.exr").stat().st_size < 0.8 * (tmp_path / "plain.exr").stat().st_size


@pytest.mark.parametrize("names", [("depth",), ("R", "G", "B"), ("A", "Z"), ("Y", "A", "X")])
def test_depth_is_the_only_channel_or_the_one_of_its_names(
    tmp_path: Path, save_exr: SaveExr, names: tuple[str, ...]
) -> None:
    channels = {name: np.full((3, 5), 9.0, np.float16) for name in names}
    depth = next(name for name in ("depth", "R", "Z", "Y") if name in names)
    save_exr(tmp_path / "a.exr", {**channels, depth: SMOOTH[:3, :5]})
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), SMOOTH[:3, :5])


def test_channels_of_other_names_are_refused(tmp_path: Path, save_exr: SaveExr) -> None:
    save_exr(tmp_path / "a.exr", {"U": SMOOTH, "V": SMOOTH})
    with pytest.raises(SlamError, match=r"has the channels U, V; .*a\.exr"):
        read_exr(tmp_path / "a.exr")


def test_other_compressions_and_tiles_are_refused(tmp_path: Path, save_exr: SaveExr) -> None:
    save_exr(tmp_path / "a.exr", {"R": SMOOTH}, 4)
    with pytest.raises(SlamError, match=r"compressed by PIZ, only ZIP, ZIPS and none"):
        read_exr(tmp_path / "a.exr")
    save_exr(tmp_path / "a.exr", {"R": SMOOTH}, flags=2 | 0x200)
    with pytest.raises(SlamError, match="of tiles or of several parts"):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.1, 0.5, 0.99])
@pytest.mark.parametrize("compression", [0, 3])
def test_a_file_that_is_cut_off_is_broken(
    tmp_path: Path, save_exr: SaveExr, share: float, compression: int
) -> None:
    path = tmp_path / "a.exr"
    save_exr(path, {"R": IMAGES["noise"]}, compression)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    broken = read_exr(path)
    assert isinstance(broken, BrokenImage)
    assert broken.path == path


def test_damage_is_broken(tmp_path: Path, save_exr: SaveExr) -> None:
    path = tmp_path / "a.exr"
    save_exr(path, {"R": SMOOTH})
    content = bytearray(path.read_bytes())
    for i in range(0, len(content), 7):
        damaged = content.copy()
        damaged[i] ^= 0xFF
        path.write_bytes(damaged)
        try:
            read_exr(path)  # numbers or a broken image, but no other exception
        except SlamError:
            continue


def test_something_else_and_nothing_are_broken(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    assert read_exr(path) == BrokenImage(path, "No such file or directory")
    path.write_text("hello")
    assert read_exr(path) == BrokenImage(path, "not an OpenEXR image")


def test_a_header_that_leads_back_to_itself_is_damaged(
    tmp_path: Path, save_exr: Callable[..., None]
) -> None:
    path = tmp_path / "depth.exr"
    save_exr(path, {"R": np.ones((2, 3), np.float32)})
    content = bytearray(path.read_bytes())
    at = content.index(b"chlist\0") + 7
    content[at : at + 4] = (-20).to_bytes(4, "little", signed=True)
    path.write_bytes(content)
    assert isinstance(read_exr(path), BrokenImage)

# SPDX-License-Identifier: Apache-2.0
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.images import depth_units, is_depth, read_depth
from slam.types import SlamError

NOISE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 65536, (48, 64), dtype=np.uint16)


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1].tobytes())


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


@pytest.mark.parametrize("lost_bytes", [1, 12, 1000])
def test_a_cut_off_depth_image_is_broken(tmp_path: Path, lost_bytes: int) -> None:
    path = tmp_path / "depth.png"
    path.write_bytes(encoded(".png", DEPTH)[:-lost_bytes])
    broken = read_depth(path, 5000.0)
    # Of the end mark itself, its checksum alone may be lost: all pixels are there then.
    assert isinstance(broken, BrokenImage) or lost_bytes == 1


def test_depth_is_told_by_its_kind(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    assert not is_depth(path)
    for image, answer in ((DEPTH, True), (NOISE, False), (NOISE[..., 0], False)):
        path.write_bytes(encoded(".png", image))
        assert is_depth(path) == answer
    path.write_bytes(encoded(".png", np.dstack([DEPTH] * 3)))
    assert not is_depth(path)


@pytest.mark.parametrize("kind", ["npy", "exr", "pgm", "tiff", "pfm", "npy of float64"])
def test_depth_may_be_of_many_kinds(tmp_path: Path, kind: str) -> None:
    metres = np.array([[1.0, 2.5], [0.0, 4.0]], np.float32)
    path = tmp_path / f"depth.{kind[:4].strip()}"
    if kind == "pgm":
        path.write_bytes(encoded(".pgm", (1000 * metres).astype(np.uint16)))
    elif kind == "exr":
        path.write_bytes(exr(metres))
    elif kind.startswith("npy"):
        metres[1, 0] = np.nan
        np.save(path, metres.astype(np.float64 if "64" in kind else np.float32))
    else:
        path.write_bytes(encoded(path.suffix, metres))
    units = depth_units([path], 1000.0)
    assert units == (1000.0 if kind == "pgm" else 1.0)
    depth_m = read_depth(path, units)
    assert not isinstance(depth_m, BrokenImage)
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, [[1.0, 2.5], [0.0, 4.0]])
    assert is_depth(path)


def exr(values: np.ndarray) -> bytes:
    """Return an OpenEXR image of one channel Z, not compressed."""
    height, width = values.shape
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channels = b"Z\0" + struct.pack("<iiii", 2, 0, 1, 1) + b"\0"
    header = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    for name, kind, value in (
        (b"channels", b"chlist", channels),
        (b"compression", b"compression", b"\0"),
        (b"dataWindow", b"box2i", box),
    ):
        header += name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value
    header += b"\0"
    rows = [struct.pack("<ii", y, 4 * width) + row.tobytes() for y, row in enumerate(values)]
    first = len(header) + 8 * height
    table = b"".join(struct.pack("<Q", first + y * len(rows[0])) for y in range(height))
    return header + table + b"".join(rows)


def test_floating_point_millimetres_are_known_by_their_size(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.full((4, 4), 1500.0))
    assert depth_units([tmp_path / "none.npy", tmp_path / "depth.npy"], 1000.0) == 1000.0
    depth_m = read_depth(tmp_path / "depth.npy", 1000.0)
    assert not isinstance(depth_m, BrokenImage)
    np.testing.assert_allclose(depth_m, 1.5)


def test_arrays_of_whole_numbers_are_in_the_units_of_the_scale(tmp_path: Path) -> None:
    path = tmp_path / "depth.npy"
    for kind, values in (("u2", [[0, 2000, 65535]]), ("i4", [[-1, 2000, 0]])):
        np.save(path, np.array(values, kind)[None])
        assert depth_units([path], 1000.0) == 1000.0
        depth_m = read_depth(path, 1000.0)
        assert not isinstance(depth_m, BrokenImage)
        np.testing.assert_allclose(depth_m, [[0.0, 2.0, 0.0]])


@pytest.mark.parametrize("array", [np.zeros(4), np.zeros((2, 2, 2)), np.array([["a", "b"]])])
def test_an_array_without_rows_and_columns_is_broken(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "depth.npy", array)
    broken = read_depth(tmp_path / "depth.npy", 1000.0)
    assert isinstance(broken, BrokenImage) and "rows and columns" in broken.why


def test_what_is_in_a_file_counts_and_not_its_name(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.ones((4, 4), np.float32))
    named = (tmp_path / "depth.npy").rename(tmp_path / "depth.png")
    assert isinstance(read_depth(named, 1.0), np.ndarray)
    named.write_bytes(named.read_bytes()[:-8])
    assert read_depth(named, 1.0) == BrokenImage(named, "the file is cut off, or no array")

# SPDX-License-Identifier: Apache-2.0
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence, write_camera
from slam.demo.room import Room, render
from slam.types import Camera

Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]
SaveExr = Callable[..., None]
# Upright, as the app records unless the phone is turned.
DEPTH = Camera(96, 128, 100.0, 100.0, 47.5, 63.5, depth_scale=1.0)
COLOR = Camera(720, 960, 750.0, 750.0, 359.5, 479.5, depth_scale=1.0)


@pytest.fixture(scope="module")
def phone(take: Callable[..., Any]) -> Any:
    """Return 3 frames whose colour images are far larger than the depth images."""
    return take(3, DEPTH, COLOR)


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Path:
    return export("record3d", tiny_walk)


def change(folder: Path, **values: object) -> None:
    file = folder / "metadata.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def test_colour_and_depth_meet_at_a_size_between_theirs(
    export: Export, phone: Any, room: Room, opened: Opened
) -> None:
    sequence = opened(export("record3d", phone))
    assert sequence.warnings == ()
    assert sequence.ground_truth is None
    camera, frame = sequence.camera, sequence.frame(1)
    assert (camera.width, camera.height, camera.fx) == (480, 640, pytest.approx(500.0))
    seen = render(room, camera, phone.T_world_depth[1])
    assert np.abs(frame.rgb.astype(int) - seen.rgb).mean() < 4.0
    off_m = np.abs(frame.depth_m - seen.depth_m)[frame.depth_m > 0.0]
    assert np.median(off_m) < 0.005


def test_frames_follow_each_other_by_the_rate(tiny: Path, tiny_walk: Any, opened: Opened) -> None:
    change(tiny, fps=60)
    sequence = opened(tiny)
    assert sequence.camera == tiny_walk.camera_in(1.0)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 60.0)
    for i, frame in enumerate(sequence):
        assert frame.rgb[0, 0, 0] == i
        np.testing.assert_allclose(frame.depth_m, 1.0 + i / 10.0, atol=1e-6)


def test_times_of_their_own_go_before_the_rate(tiny: Path, opened: Opened) -> None:
    change(tiny, fps=60, frameTimestamps=[0.5, 0.6, 0.7, 0.85, 1.0, 1.1])
    (tiny / "rgb/1.png").unlink()
    np.testing.assert_allclose(opened(tiny).timestamps_s, [0.5, 0.7, 0.85, 1.0, 1.1])


def test_numbers_are_counted_not_spelled(tiny: Path, opened: Opened) -> None:
    (tiny / "rgb/5.png").rename(tiny / "rgb/10.png")
    (tiny / "depth/5.exr").rename(tiny / "depth/10.exr")
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == list(range(6))
    np.testing.assert_allclose(sequence.timestamps_s, np.array([0, 1, 2, 3, 4, 10]) / 30.0)


def test_where_the_focus_changes_the_camera_is_the_median(tiny: Path, opened: Opened) -> None:
    change(tiny, perFrameIntrinsicCoeffs=[[30 + i / 10, 31, 15, 11] for i in (0, 0, 2, 2, 2, 3)])
    camera, warnings = opened(tiny).camera, opened(tiny).warnings
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (pytest.approx(30.2), 31, 15, 11)
    assert warnings == ()
    change(tiny, perFrameIntrinsicCoeffs=[[30 + i, 30, 15, 11] for i in range(6)])
    assert "the focal length changes from 30 to 35 px" in opened(tiny).warnings[0]


def test_what_is_no_distance_is_unknown(tiny: Path, save_exr: SaveExr, opened: Opened) -> None:
    depth = np.full((24, 32), 1.5, np.float16)
    depth[0, :3] = np.nan, np.inf, -1.0
    save_exr(tiny / "depth/1.exr", {"R": depth})
    depth_m = opened(tiny).frame(1).depth_m
    assert depth_m[0, :3].tolist() == [0.0, 0.0, 0.0]
    assert (depth_m > 0.0).sum() == depth.size - 3


def test_missing_and_cut_off_images_are_skipped_and_said(tiny: Path, opened: Opened) -> None:
    (tiny / "depth/2.exr").unlink()
    for cut in (tiny / "depth/3.exr", tiny / "rgb/4.png"):
        cut.write_bytes(cut.read_bytes()[:-20])
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 1, 5]
    assert [broken.why for broken in sequence.skipped] == [
        "the file is missing",
        "the file is cut off or damaged",
        "the file is cut off",
    ]


def test_a_named_camera_is_that_of_the_colour_images(
    export: Export, phone: Any, tmp_path: Path
) -> None:
    folder = export("record3d", phone)
    mine = Camera(720, 960, 900.0, 900.0, 359.5, 479.5, depth_scale=1.0)
    write_camera(tmp_path / "mine.toml", mine)
    sequence = open_sequence(folder, InputConfig(camera=tmp_path / "mine.toml", depth_scale=2.0))
    assert (sequence.camera.width, sequence.camera.fx) == (480, pytest.approx(600.0))
    assert sequence.frame(0).depth_m.max() == pytest.approx(0.5 * phone.depth_m[0].max())


def test_images_of_the_wrong_size_are_refused(tiny: Path, save_exr: SaveExr, fails: Fails) -> None:
    save_exr(tiny / "depth/0.exr", {"R": np.ones((32, 24), np.float32)})
    fails(tiny, "a depth image has 24x32 pixels, which is not the shape of its colour image")
    cv2.imwrite(str(tiny / "rgb/0.png"), np.zeros((48, 64, 3), np.uint8))
    fails(tiny, "a colour image has 64x48 pixels but the camera 32x24")


def test_depth_that_is_not_compressed_by_zip_is_refused(
    tiny: Path, save_exr: SaveExr, fails: Fails
) -> None:
    save_exr(tiny / "depth/0.exr", {"R": np.ones((24, 32), np.float32)}, 4)
    assert fails(tiny, "compressed by PIZ").endswith("0.exr")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"K": [1, 2, 3]}, "K does not have 9 numbers, column by column"),
        ({"K": ["x"] * 9}, "the key K does not hold numbers"),
        ({"K": [float("nan")] * 9}, "the key K holds a number that is not finite"),
        ({"w": None}, "camera key width = None"),
        ({"w": 10}, "cx, cy = 15.5, 11.5 lie outside the image of 10x24"),
        ({"fps": 0}, "fps = 0 is no frame rate"),
        ({"fps": "fast"}, "the key fps does not hold numbers"),
        ({"fps": [30, 60]}, "fps = [30, 60] is no frame rate"),
        ({"frameTimestamps": [0.0, 0.1]}, "frameTimestamps are 2, for 6 images"),
        ({"frameTimestamps": [0.0, None] * 3}, "frameTimestamps holds a number that is not finite"),
        ({"perFrameIntrinsicCoeffs": [[1, 2]]}, "is not fx, fy, cx, cy of each frame"),
    ],
)
def test_metadata_that_are_wrong_are_named(
    tiny: Path, values: dict[str, object], said: str, fails: Fails
) -> None:
    change(tiny, **values)
    assert fails(tiny, said).endswith("metadata.json")


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "not valid JSON"), ("[1]", "names and values"), ("{}", "the key K is missing")],
)
def test_metadata_that_are_none_are_named(tiny: Path, text: str, said: str, fails: Fails) -> None:
    (tiny / "metadata.json").write_text(text)
    assert fails(tiny, said).endswith("metadata.json")


def test_an_unpacked_r3d_says_what_to_export_instead(tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "rgbd").mkdir()
    for name in ("metadata", "rgbd/0.jpg", "rgbd/0.depth", "rgbd/0.conf"):
        (tmp_path / name).write_bytes(b"")
    fails(tmp_path, 'LZFSE, which is not read here; export the recording from Record3D as "EXR + J')

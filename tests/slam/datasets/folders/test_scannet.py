# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.datasets import Sequence, write_camera
from slam.demo.room import Room, render
from slam.types import Camera

Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]

# Half the size of what scene0000_00 was recorded with, and the same proportions.
COLOR = Camera(648, 484, 584.8, 583.5, 322.9, 244.7, depth_scale=1000.0)
DEPTH = Camera(320, 240, 288.9, 288.9, 159.5, 119.5, depth_scale=1000.0)


@pytest.fixture(scope="module")
def scan(take: Callable[..., Any]) -> Any:
    """Return 3 frames whose colour images are twice as large as the depth images."""
    return take(3, DEPTH, COLOR)


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Path:
    return export("scannet", tiny_walk)


def test_colour_is_brought_to_the_size_of_depth_and_fits_it(
    export: Export, scan: Any, room: Room, opened: Opened
) -> None:
    sequence = opened(export("scannet", scan))
    camera, frame = sequence.camera, sequence.frame(1)
    assert (camera.width, camera.height, camera.depth_scale) == (320, 240, 1000.0)
    assert camera.fx == pytest.approx(584.8 * 320 / 648)
    assert camera.cy == pytest.approx((244.7 + 0.5) * 240 / 484 - 0.5)
    seen = render(room, camera, scan.T_world_depth[1])
    assert np.abs(frame.rgb.astype(int) - seen.rgb).mean() < 4.0
    off_m = np.abs(frame.depth_m - seen.depth_m)[frame.depth_m > 0.0]
    assert (frame.depth_m > 0.0).mean() > 0.98
    assert np.median(off_m) < 0.002
    # Shifted by two pixels the colours fit much worse: the bound above can fail.
    assert np.abs(np.roll(frame.rgb, 2, axis=1).astype(int) - seen.rgb).mean() > 8.0


def test_two_frames_see_the_same_surfaces_at_the_same_place(
    export: Export, scan: Any, disagreement: Callable[..., Any], opened: Opened
) -> None:
    off_m = disagreement(opened(export("scannet", scan)), 0, 2)
    assert len(off_m) > 30_000
    assert np.median(np.abs(off_m)) < 0.004


def test_without_the_depth_cameras_intrinsics_it_sees_what_colour_sees(
    export: Export, scan: Any, opened: Opened
) -> None:
    folder = export("scannet", scan)
    with_both = opened(folder)
    (folder / "intrinsic/intrinsic_depth.txt").unlink()
    without = opened(folder)
    assert without.camera == with_both.camera
    np.testing.assert_allclose(
        without.frame(0).depth_m, np.rint(1000 * scan.depth_m[0]) / 1000, atol=1e-6
    )


def test_colour_that_was_made_small_when_exported_has_the_depth_cameras_intrinsics(
    export: Export, scan: Any, opened: Opened
) -> None:
    folder = export("scannet", scan)
    for path in (folder / "color").iterdir():
        small = cv2.resize(cv2.imread(str(path)), (320, 240), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(path), small)
    assert opened(folder).camera == DEPTH


def test_where_a_camera_is_named_nothing_is_moved(export: Export, scan: Any, fails: Fails) -> None:
    folder = export("scannet", scan)
    write_camera(folder / "camera.toml", COLOR)
    fails(folder, "a depth image has 320x240 pixels but its colour image 648x484")
    write_camera(folder / "camera.toml", replace(DEPTH, fx=300.0))
    fails(folder, "a colour image has 648x484 pixels but the camera 320x240")


def test_numbers_are_counted_not_spelled_and_tell_the_time(tiny: Path, opened: Opened) -> None:
    for kind, suffix in (("color", "png"), ("depth", "png"), ("pose", "txt")):
        (tiny / f"{kind}/5.{suffix}").rename(tiny / f"{kind}/10.{suffix}")
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == list(range(6))
    np.testing.assert_allclose(sequence.timestamps_s, np.array([0, 1, 2, 3, 4, 10]) / 30.0)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, sequence.timestamps_s)
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == list(range(6))


def test_two_images_of_one_number_are_one_too_many(tiny: Path, fails: Fails) -> None:
    (tiny / "color/0003.jpg").write_bytes(b"")
    fails(tiny, "two images have the number 3, 0003.jpg and 3.png")


def test_a_pose_of_minus_infinity_is_unknown(tiny: Path, opened: Opened) -> None:
    for i in (1, 4):
        (tiny / f"pose/{i}.txt").write_text("-inf -inf -inf -inf\n" * 4)
    sequence = opened(tiny)
    assert len(sequence) == 6
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == [0, 2, 3, 5]
    assert "2 of 6 frames have no true pose" in sequence.warnings[0]


@pytest.mark.parametrize("value", ["nan", "0", "inf"])
def test_a_pose_that_holds_no_number_is_a_gap(tiny: Path, opened: Opened, value: str) -> None:
    known = opened(tiny).ground_truth
    (tiny / "pose/2.txt").write_text(f"{value} {value} {value} {value}\n" * 4)
    with_gap = opened(tiny).ground_truth
    assert known is not None and with_gap is not None
    assert len(with_gap) == len(known) - 1


def test_a_recording_without_poses_has_no_truth(tiny: Path, opened: Opened) -> None:
    for file in (tiny / "pose").iterdir():
        file.unlink()
    (tiny / "pose").rmdir()
    assert opened(tiny).ground_truth is None


def test_depth_without_colour_is_said(tiny: Path, opened: Opened) -> None:
    (tiny / "color/2.png").unlink()
    sequence = opened(tiny)
    assert len(sequence) == 5
    assert "1 of 6 depth images have no colour image" in sequence.warnings[0]


def test_a_folder_without_images_is_named(tiny: Path, fails: Fails) -> None:
    for file in (tiny / "depth").iterdir():
        file.unlink()
    assert fails(tiny, "the folder holds no numbered image").endswith("depth")


def test_sizes_are_of_the_first_image_that_is_whole(
    tiny: Path, fails: Fails, opened: Opened
) -> None:
    broken = tiny / "color/0.png"
    broken.write_bytes(broken.read_bytes()[:-20])
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [1, 2, 3, 4, 5]
    for file in (tiny / "depth").iterdir():
        file.write_bytes(b"")
    assert fails(tiny, "none of the images can be read").endswith("depth/0.png")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("30 0 15\n0 30 11\n0 0 1\n", "a matrix of 4 x 4 numbers"),
        ("0 0 15 0\n0 30 11 0\n0 0 1 0\n0 0 0 1\n", "camera key fx = "),
        ("30 0 647 0\n0 30 11 0\n0 0 1 0\n0 0 0 1\n", "cx, cy = 647, 11 lie outside the image"),
        ("nan 0 15 0\n0 30 11 0\n0 0 1 0\n0 0 0 1\n", "camera key fx = "),
    ],
)
def test_intrinsics_that_are_none_are_named(tiny: Path, text: str, said: str, fails: Fails) -> None:
    (tiny / "intrinsic/intrinsic_depth.txt").write_text(text)
    assert fails(tiny, said).endswith("intrinsic_depth.txt")

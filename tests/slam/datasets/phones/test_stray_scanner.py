# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence, write_camera
from slam.datasets.phones.stray_scanner import stray_odometry
from slam.demo.room import Room, render
from slam.types import Camera

Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]
DEPTH = Camera(128, 96, 100.0, 100.0, 63.5, 47.5, depth_scale=1000.0)
COLOR = Camera(960, 720, 750.0, 750.0, 479.5, 359.5, depth_scale=1000.0)


@pytest.fixture(scope="module")
def phone(take: Callable[..., Any]) -> Any:
    """Return 3 frames whose colour images are far larger than the depth images."""
    return take(3, DEPTH, COLOR)


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Path:
    return export("stray_scanner", tiny_walk)


@pytest.fixture
def filmed(tiny: Path) -> Path:
    """Write the tiny frames with a video instead of images; frame i is of grey 20 i."""
    film(tiny, 6)
    return tiny


def film(folder: Path, count: int) -> None:
    path = folder / "rgb.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (32, 24))
    for i in range(count):
        writer.write(np.full((24, 32, 3), 20 * i, np.uint8))
    writer.release()
    for image in (folder / "rgb").glob("*"):
        image.unlink()


def grey(sequence: Sequence) -> list[int]:
    return [round(frame.rgb[12, 16, 0] / 20) for frame in sequence]


def table(folder: Path) -> list[str]:
    return (folder / "odometry.csv").read_text().splitlines()


def rewrite(folder: Path, lines: list[str]) -> None:
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")


def test_colour_and_depth_meet_at_a_size_between_theirs(
    export: Export, phone: Any, room: Room, opened: Opened
) -> None:
    sequence = opened(export("stray_scanner", phone))
    assert sequence.warnings == ()
    assert sequence.ground_truth is None
    camera, frame = sequence.camera, sequence.frame(1)
    assert (camera.width, camera.height, camera.fx) == (640, 480, pytest.approx(500.0))
    seen = render(room, camera, phone.T_world_depth[1])
    assert np.abs(frame.rgb.astype(int) - seen.rgb).mean() < 4.0
    off_m = np.abs(frame.depth_m - seen.depth_m)[frame.depth_m > 0.0]
    assert np.median(off_m) < 0.005
    # Shifted by a pixel of the depth image it fits worse: the bound above can fail.
    moved_m = np.abs(np.roll(frame.depth_m, 5, axis=1) - seen.depth_m)[frame.depth_m > 0.0]
    assert np.median(moved_m) > 1.5 * np.median(off_m)


def test_frames_have_the_times_of_the_table(tiny: Path, tiny_walk: Any, opened: Opened) -> None:
    sequence = opened(tiny)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0, atol=1e-6)
    assert sequence.camera == tiny_walk.camera_in(1000.0)
    for i, frame in enumerate(sequence):
        assert frame.rgb[0, 0, 0] == i
        np.testing.assert_allclose(frame.depth_m, 1.0 + i / 10.0)


def test_frames_may_be_in_a_video(filmed: Path, tiny_walk: Any, opened: Opened) -> None:
    sequence = opened(filmed)
    assert sequence.camera == tiny_walk.camera_in(1000.0)
    assert sequence.warnings == ()
    assert grey(sequence) == grey(sequence) == list(range(6))
    assert round(sequence.frame(4).rgb[12, 16, 0] / 20) == 4
    np.testing.assert_allclose(sequence.frame(4).depth_m, 1.4)


def test_a_frame_without_depth_is_skipped_and_the_video_goes_on(
    filmed: Path, opened: Opened
) -> None:
    (filmed / "depth/000002.png").unlink()
    cut = filmed / "depth/000004.png"
    cut.write_bytes(cut.read_bytes()[:-20])
    sequence = opened(filmed)
    assert grey(sequence) == [0, 1, 3, 5]
    assert [broken.why for broken in sequence.skipped] == [
        "the file is missing",
        "the file is cut off",
    ]


def test_a_video_that_is_a_frame_short_is_said_and_its_last_frame_skipped(
    tiny: Path, opened: Opened
) -> None:
    film(tiny, 5)
    sequence = opened(tiny)
    assert sequence.warnings[0] == (
        "rgb.mp4 has 5 frames, odometry.csv counts 6; colour may be 1 frame(s) off its depth"
    )
    assert grey(sequence) == [0, 1, 2, 3, 4]
    assert sequence.skipped == [
        (tiny / "rgb.mp4/000005", "the video ends before, or is damaged"),
    ]


@pytest.mark.parametrize("count", [3, 9])
def test_a_video_of_another_count_is_refused(tiny: Path, count: int, fails: Fails) -> None:
    film(tiny, count)
    fails(tiny, f"rgb.mp4 has {count} frames, odometry.csv counts 6; which colour belongs")


def test_a_video_that_is_none_is_refused(filmed: Path, fails: Fails) -> None:
    (filmed / "rgb.mp4").write_bytes(b"")
    assert fails(filmed, "the video cannot be opened").endswith("rgb.mp4")


def test_depth_of_low_confidence_is_unknown(tiny: Path, opened: Opened) -> None:
    confidence = np.zeros((24, 32), np.uint8)
    confidence[:, 10:20], confidence[:, 20:] = 1, 2
    cv2.imwrite(str(tiny / "confidence/000001.png"), confidence)
    depth_m = opened(tiny).frame(1).depth_m
    assert (depth_m[:, :10] == 0.0).all()
    np.testing.assert_allclose(depth_m[:, 10:], 1.1)


def test_without_confidence_depth_is_used_and_said(tiny: Path, opened: Opened) -> None:
    for file in (tiny / "confidence").iterdir():
        file.unlink()
    (tiny / "confidence").rmdir()
    sequence = opened(tiny)
    assert "no folder confidence/" in sequence.warnings[0]
    np.testing.assert_allclose(sequence.frame(1).depth_m, 1.1)


def test_a_frame_without_usable_confidence_is_skipped(tiny: Path, opened: Opened) -> None:
    (tiny / "confidence/000001.png").unlink()
    cv2.imwrite(str(tiny / "confidence/000003.png"), np.ones((12, 16), np.uint8))
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 2, 4, 5]
    assert [(broken.path.name, broken.why) for broken in sequence.skipped] == [
        ("000001.png", "No such file or directory"),
        ("000003.png", "not of the size of its depth image"),
    ]


def test_depth_may_be_arrays(tiny: Path, opened: Opened) -> None:
    for file in sorted((tiny / "depth").iterdir()):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert image is not None
        np.save(file.with_suffix(".npy"), image)
        file.unlink()
    np.save(tiny / "depth/000001.npy", np.full((24, 32), 1100.0, np.float32))
    np.save(tiny / "depth/000002.npy", np.ones((24, 32, 3), np.uint16))
    cut = tiny / "depth/000003.npy"
    cut.write_bytes(cut.read_bytes()[:-20])
    sequence = opened(tiny)
    frames = list(sequence)
    assert [frame.rgb[0, 0, 0] for frame in frames] == [0, 1, 4, 5]
    np.testing.assert_allclose(frames[1].depth_m, 1.1)
    np.testing.assert_allclose(frames[3].depth_m, 1.5)
    assert [broken.why for broken in sequence.skipped] == [
        "not an array of rows and columns of numbers",
        "the file is cut off, or no array",
    ]


def test_a_named_camera_is_that_of_the_colour_images(
    export: Export, phone: Any, tmp_path: Path
) -> None:
    folder = export("stray_scanner", phone)
    write_camera(tmp_path / "mine.toml", Camera(960, 720, 900.0, 900.0, 479.5, 359.5))
    sequence = open_sequence(folder, InputConfig(camera=tmp_path / "mine.toml", depth_scale=500.0))
    assert (sequence.camera.width, sequence.camera.fx) == (640, pytest.approx(600.0))
    assert sequence.frame(0).depth_m.max() == pytest.approx(2.0 * phone.depth_m[0].max(), abs=0.002)


def test_images_of_the_wrong_size_are_refused(
    export: Export, phone: Any, tiny_walk: Any, fails: Fails
) -> None:
    folder = export("stray_scanner", phone)
    cv2.imwrite(str(folder / "depth/000000.png"), np.ones((128, 96), np.uint16))
    cv2.imwrite(str(folder / "confidence/000000.png"), np.ones((128, 96), np.uint8))
    fails(folder, "a depth image has 96x128 pixels, which is not the shape of its colour image")
    write_camera(folder / "camera.toml", tiny_walk.camera_in(1000.0))
    fails(folder, "a colour image has 960x720 pixels but the camera 32x24")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda lines: lines[:1], "the table has no line behind its header"),
        (lambda lines: [], "the table has no column frame or timestamp or x"),
        (lambda lines: [lines[0].replace("timestamp", "t"), *lines[1:]], "no column timestamp"),
        (lambda lines: [*lines[:3], lines[3][:20]], "line 4 of the table is too short"),
        (lambda lines: [*lines, "nan, 000006, 0, 0, 0, 0, 0, 0, 1"], "line 8 is no frame, time"),
        (lambda lines: [*lines, "9, 000006, 0, nan, 0, 0, 0, 0, 1"], "line 8 is no frame, time"),
        (lambda lines: [*lines, "9, 6.5, 0, 0, 0, 0, 0, 0, 1"], "line 8 is no frame, time"),
        (lambda lines: [*lines, "9, , 0, 0, 0, 0, 0, 0, 1"], "line 8 is no frame, time"),
        (lambda lines: [*lines, "9, 000006, 0, 0, 0, 0, 0, 0, 0"], "a quaternion of length zero"),
        (
            lambda lines: [lines[0], "9, 000077, 0, 0, 0, 0, 0, 0, 1"],
            "no line is of a frame that has a colour image",
        ),
    ],
)
def test_a_table_that_is_wrong_is_named(
    tiny: Path, change: Callable[[list[str]], list[str]], said: str, fails: Fails
) -> None:
    rewrite(tiny, change(table(tiny)))
    assert fails(tiny, said).endswith("odometry.csv")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a matrix of 3 x 3 numbers"),
        ("30, 0, 99\n0, 30, 11\n0, 0, 1", "cx, cy = 99, 11 lie outside the image of 32x24"),
        ("nan, 0, 15\n0, 30, 11\n0, 0, 1", "camera key fx = nan"),
    ],
)
def test_a_camera_matrix_that_is_none_is_named(
    tiny: Path, text: str, said: str, fails: Fails
) -> None:
    (tiny / "camera_matrix.csv").write_text(text)
    assert fails(tiny, said).endswith("camera_matrix.csv")


def test_a_missing_camera_matrix_is_named(tiny: Path, fails: Fails) -> None:
    (tiny / "camera_matrix.csv").unlink()
    fails(tiny, "it would be Stray Scanner with camera_matrix.csv")


def test_the_phones_own_path_can_be_had(tiny: Path, tiny_walk: Any) -> None:
    lines = table(tiny)
    rewrite(tiny, [lines[0], *lines[:0:-1]])
    odometry = stray_odometry(tiny)
    np.testing.assert_allclose(odometry.timestamps_s, np.arange(6) / 30.0, atol=1e-6)
    np.testing.assert_allclose(odometry.T_world_cam, tiny_walk.T_world_depth, atol=1e-9)

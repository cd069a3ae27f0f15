# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.datasets import Sequence, write_camera
from slam.datasets.folders.seven_scenes import KINECT
from slam.demo.room import Room, render
from slam.geometry import se3

Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]


@pytest.fixture(scope="module")
def kinect(take: Callable[..., Any]) -> Any:
    """Return 3 frames of two cameras that stand side by side."""
    return take(3, KINECT.depth_camera, KINECT.color_camera, se3.inverse(KINECT.T_color_depth))


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Path:
    """Write tiny frames; the Kinect does not fit them, so their camera is named."""
    folder = export("seven_scenes", tiny_walk)
    write_camera(folder / "camera.toml", tiny_walk.camera_in(1000.0))
    return folder


def test_the_calibration_is_a_rigid_motion_of_a_few_centimetres() -> None:
    R = KINECT.T_color_depth[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-7)
    assert 0.02 < np.linalg.norm(KINECT.T_color_depth[:3, 3]) < 0.03
    assert KINECT.T_color_depth[0, 3] < 0.0  # a Kinect's depth camera sees from the left of colour


def test_depth_is_moved_to_where_the_colour_camera_sees_it(
    export: Export, kinect: Any, room: Room, opened: Opened
) -> None:
    sequence = opened(export("seven_scenes", kinect))
    assert sequence.camera == KINECT.color_camera
    assert sequence.ground_truth is not None
    frame = sequence.frame(1)
    seen = render(room, sequence.camera, sequence.ground_truth.T_world_cam[1])
    assert (frame.rgb == kinect.rgb[1]).all()
    np.testing.assert_allclose(frame.rgb.astype(int), seen.rgb, atol=3)
    known = frame.depth_m > 0.0
    assert known[40:440, 60:580].mean() > 0.9  # what the narrower depth camera covers
    off_m = np.abs(frame.depth_m - seen.depth_m)[known]
    assert np.median(off_m) < 0.002
    assert (off_m < 0.02).mean() > 0.95
    # The very check finds fault with depth that stays where it was.
    assert np.median(np.abs(kinect.depth_m[1] - seen.depth_m)) > 0.02


def test_two_frames_see_the_same_surfaces_at_the_same_place(
    export: Export, kinect: Any, disagreement: Callable[..., Any], opened: Opened
) -> None:
    off_m = disagreement(opened(export("seven_scenes", kinect)), 0, 2)
    assert len(off_m) > 100_000
    assert np.median(np.abs(off_m)) < 0.003


def test_65535_is_no_depth(tiny: Path, opened: Opened) -> None:
    depth = np.full((24, 32), 1500, np.uint16)
    depth[3, 4], depth[5, 6] = 65535, 0
    cv2.imwrite(str(tiny / "frame-000001.depth.png"), depth)
    depth_m = opened(tiny).frame(1).depth_m
    assert (depth_m[3, 4], depth_m[5, 6]) == (0.0, 0.0)
    assert (depth_m > 0.0).sum() == depth.size - 2
    assert depth_m.max() == 1.5


def test_where_a_camera_is_named_nothing_is_moved(
    tiny: Path, tiny_walk: Any, opened: Opened
) -> None:
    sequence = opened(tiny)
    assert sequence.camera == tiny_walk.camera_in(1000.0)
    assert sequence.ground_truth is not None
    np.testing.assert_array_equal(sequence.ground_truth.T_world_cam, tiny_walk.T_world_depth)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0)
    np.testing.assert_allclose(sequence.frame(2).depth_m, 1.2)


def test_frames_that_are_left_out_keep_their_time(tiny: Path, opened: Opened) -> None:
    for file in tiny.glob("frame-000003.*"):
        file.unlink()
    sequence = opened(tiny)
    np.testing.assert_allclose(sequence.timestamps_s, np.array([0, 1, 2, 4, 5]) / 30.0)
    assert sequence.warnings == ()


def test_missing_and_cut_off_images_are_skipped_and_said(tiny: Path, opened: Opened) -> None:
    (tiny / "frame-000002.depth.png").unlink()
    cut = tiny / "frame-000004.color.png"
    cut.write_bytes(cut.read_bytes()[:-20])
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 1, 3, 5]
    assert [broken.why for broken in sequence.skipped] == [
        "the file is missing",
        "the file is cut off",
    ]


def test_more_than_half_missing_is_an_error(tiny: Path, fails: Fails) -> None:
    for i in range(4):
        (tiny / f"frame-00000{i}.depth.png").unlink()
    fails(tiny, "more than half of the 6 frames")


def test_images_of_another_size_are_named(export: Export, tiny_walk: Any, fails: Fails) -> None:
    fails(export("seven_scenes", tiny_walk), "has 32x24 pixels but the camera 640x480")


def test_depth_of_another_size_is_named(export: Export, kinect: Any, fails: Fails) -> None:
    folder = export("seven_scenes", kinect)
    cv2.imwrite(str(folder / "frame-000000.depth.png"), np.ones((240, 320), np.uint16))
    fails(folder, "a depth image has 320x240 pixels but the depth camera 640x480")


def test_a_frame_without_a_pose_has_no_truth(tiny: Path, opened: Opened) -> None:
    (tiny / "frame-000001.pose.txt").unlink()
    sequence = opened(tiny)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == [0, 2, 3, 4, 5]
    assert "1 of 6 frames have no true pose" in sequence.warnings[0]
    for file in tiny.glob("*.pose.txt"):
        file.unlink()
    assert opened(tiny).ground_truth is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", "a matrix of 4 x 4 numbers"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 zero\n0 0 0 1\n", "a matrix of 4 x 4 numbers"),
        ("", "a matrix of 4 x 4 numbers"),
        ("2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "no rotation and translation"),
        ("1 0 0 0\n0 -1 0 0\n0 0 1 0\n0 0 0 1\n", "no rotation and translation"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n1 2 3 1\n", "no rotation and translation"),
    ],
)
def test_a_pose_that_is_none_is_named(tiny: Path, text: str, said: str, fails: Fails) -> None:
    (tiny / "frame-000003.pose.txt").write_text(text)
    assert fails(tiny, said).endswith("frame-000003.pose.txt")


def test_rounding_in_a_pose_file_is_mended(tiny: Path, opened: Opened) -> None:
    (tiny / "frame-000003.pose.txt").write_text(
        "0.6 -0.801 0 3\n0.8 0.6 0.001 0\n0 0 1 0\n0 0 0 1\n"
    )
    truth = opened(tiny).ground_truth
    assert truth is not None
    R = truth.T_world_cam[3, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R, [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], atol=2e-3)


@pytest.fixture
def tsdf(tiny: Path, tiny_walk: Any) -> Path:
    """Write the tiny frames as the TSDF tools have them."""
    (tiny / "camera.toml").unlink()
    for file in tiny.glob("*.color.png"):
        cv2.imwrite(str(file.with_suffix(".jpg")), cv2.imread(str(file)))
        file.unlink()
    K = tiny_walk.color_camera.matrix
    (tiny / "camera-intrinsics.txt").write_text("".join(f" {a:e} {b:e} {c:e} \n" for a, b, c in K))
    return tiny


@pytest.mark.parametrize("where", ["inside", "above"])
def test_with_intrinsics_of_both_nothing_is_moved(
    tsdf: Path, tiny_walk: Any, where: str, opened: Opened
) -> None:
    if where == "above":
        (tsdf / "camera-intrinsics.txt").rename(tsdf.parent / "camera-intrinsics.txt")
    sequence = opened(tsdf)
    assert sequence.camera == tiny_walk.camera_in(1000.0)
    assert sequence.ground_truth is not None
    np.testing.assert_array_equal(sequence.ground_truth.T_world_cam, tiny_walk.T_world_depth)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0)
    for i, frame in enumerate(sequence):
        assert abs(int(frame.rgb[0, 0, 0]) - i) <= 1
        np.testing.assert_allclose(frame.depth_m, 1.0 + i / 10.0)


def test_a_named_camera_goes_before_the_intrinsics(
    tsdf: Path, tiny_walk: Any, opened: Opened
) -> None:
    write_camera(tsdf / "camera.toml", tiny_walk.camera_in(500.0))
    assert opened(tsdf).camera == tiny_walk.camera_in(500.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a matrix of 3 x 3 numbers"),
        ("30 0 15.5 0\n0 30 11.5 0\n0 0 1 0\n0 0 0 1\n", "a matrix of 3 x 3 numbers"),
        ("nan 0 15.5\n0 30 11.5\n0 0 1\n", "camera key fx = nan"),
        ("585 0 320\n0 585 240\n0 0 1\n", "cx, cy = 320, 240 lie outside the image of 32x24"),
    ],
)
def test_intrinsics_that_are_none_are_named(tsdf: Path, text: str, said: str, fails: Fails) -> None:
    (tsdf / "camera-intrinsics.txt").write_text(text)
    assert fails(tsdf, said).endswith("camera-intrinsics.txt")


def test_depth_of_another_size_than_colour_is_refused(tsdf: Path, fails: Fails) -> None:
    cv2.imwrite(str(tsdf / "frame-000000.depth.png"), np.ones((12, 16), np.uint16))
    fails(tsdf, "a depth image has 16x12 pixels but its colour image 32x24")

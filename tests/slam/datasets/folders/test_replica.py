# SPDX-License-Identifier: Apache-2.0
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.datasets import Sequence, write_camera
from slam.datasets.folders.replica import CAMERA

Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Path:
    return export("replica", tiny_walk)


def test_frames_times_camera_and_truth_are_those_of_the_folder(
    tiny: Path, tiny_walk: Any, opened: Opened
) -> None:
    sequence = opened(tiny)
    assert sequence.camera == tiny_walk.camera_in(6553.5)
    assert sequence.warnings == ()
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0)
    for i, frame in enumerate(sequence):
        assert frame.rgb[0, 0, 0] == i
        np.testing.assert_allclose(frame.depth_m, 1.0 + i / 10.0, atol=1e-4)
    assert sequence.ground_truth is not None
    np.testing.assert_array_equal(sequence.ground_truth.timestamps_s, sequence.timestamps_s)
    np.testing.assert_array_equal(sequence.ground_truth.T_world_cam, tiny_walk.T_world_depth)


def test_two_frames_see_the_same_surfaces_at_the_same_place(
    export: Export, walk: Any, disagreement: Callable[..., Any], opened: Opened
) -> None:
    off_m = disagreement(opened(export("replica", walk)), 0, 4)
    assert len(off_m) > 30_000
    assert np.median(np.abs(off_m)) < 0.004


def test_the_camera_may_be_in_the_folder_above(tiny: Path, tiny_walk: Any, opened: Opened) -> None:
    (tiny / "cam_params.json").rename(tiny.parent / "cam_params.json")
    sequence = opened(tiny)
    assert sequence.camera == tiny_walk.camera_in(6553.5)
    assert sequence.warnings == ()


def test_without_its_file_the_camera_is_that_of_the_download_and_said(
    tiny: Path, tiny_walk: Any, opened: Opened, fails: Fails
) -> None:
    (tiny / "cam_params.json").unlink()
    fails(tiny, "a colour image has 32x24 pixels but the camera 1200x680")
    for i in range(6):
        cv2.imwrite(str(tiny / f"results/frame{i:06d}.png"), np.zeros((680, 1200, 3), np.uint8))
        cv2.imwrite(str(tiny / f"results/depth{i:06d}.png"), np.full((680, 1200), 9999, np.uint16))
    sequence = opened(tiny)
    assert sequence.camera == CAMERA
    (said,) = sequence.warnings
    assert "no cam_params.json" in said
    assert "1200x680 pixels, fx = fy = 600, cx = 599.5, cy = 339.5, 6553.5 depth units" in said


def test_a_camera_file_of_ours_goes_first(tiny: Path, tiny_walk: Any, opened: Opened) -> None:
    write_camera(tiny / "camera.toml", tiny_walk.camera_in(500.0))
    assert opened(tiny).camera == tiny_walk.camera_in(500.0)


CAMERA_KEYS = {"w": 32, "h": 24, "fx": 3.0, "fy": 3.0, "cx": 1.0, "cy": 1.0}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"camera": CAMERA_KEYS}, "the camera key depth_scale is missing"),
        ({"camera": {**CAMERA_KEYS, "scale": 0.0}}, "camera key depth_scale = 0"),
        ({"camera": {**CAMERA_KEYS, "scale": 1.0, "w": "wide"}}, "camera key width = 'wide'"),
        ({"camera": 3}, "the camera key width is missing"),
    ],
)
def test_a_camera_file_that_is_wrong_is_named(
    tiny: Path, values: dict[str, object], said: str, fails: Fails
) -> None:
    (tiny / "cam_params.json").write_text(json.dumps(values))
    assert fails(tiny, said).endswith("cam_params.json")


def test_images_that_are_left_out_take_their_pose_and_time_with_them(
    tiny: Path, opened: Opened
) -> None:
    (tiny / "results/frame000003.png").unlink()
    sequence = opened(tiny)
    kept = np.array([0, 1, 2, 4, 5])
    np.testing.assert_allclose(sequence.timestamps_s, kept / 30.0)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, kept / 30.0)
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == kept.tolist()


def test_missing_and_cut_off_images_are_skipped_and_said(tiny: Path, opened: Opened) -> None:
    (tiny / "results/depth000002.png").unlink()
    cut = tiny / "results/frame000004.png"
    cut.write_bytes(cut.read_bytes()[:-20])
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 1, 3, 5]
    assert [broken.why for broken in sequence.skipped] == [
        "the file is missing",
        "the file is cut off",
    ]


def test_a_recording_without_a_trajectory_has_no_truth(tiny: Path, opened: Opened) -> None:
    (tiny / "traj.txt").unlink()
    assert opened(tiny).ground_truth is None


@pytest.mark.parametrize("value", ["nan", "0"])
def test_poses_that_are_not_known_are_gaps(tiny: Path, opened: Opened, value: str) -> None:
    gap = " ".join([value] * 16)
    (tiny / "traj.txt").write_text(f"{IDENTITY}{gap}\n{4 * IDENTITY}")
    sequence = opened(tiny)
    assert sequence.ground_truth is not None
    assert len(sequence.ground_truth) == 5
    assert "1 of 6 poses of traj.txt hold no numbers" in " ".join(sequence.warnings)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "there are 0 poses for 6 images"),
        (5 * IDENTITY, "there are 5 poses for 6 images, the last of which has the number 5"),
        (5 * IDENTITY + "1 0 0 0 0 1 0 0 0 0 1 0\n", "line 6 is not a pose, 4 x 4 numbers"),
        (IDENTITY + IDENTITY.replace("1", "one") * 5, "line 2 is not a pose"),
        (IDENTITY + IDENTITY.replace("1 0", "2 0") * 5, "the pose of line 2 is no rotation"),
    ],
)
def test_a_trajectory_that_is_wrong_is_named(
    tiny: Path, text: str, said: str, fails: Fails
) -> None:
    (tiny / "traj.txt").write_text(text)
    assert fails(tiny, said).endswith("traj.txt")

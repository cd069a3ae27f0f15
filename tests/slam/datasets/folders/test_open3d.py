# SPDX-License-Identifier: Apache-2.0
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest

from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence, write_camera
from slam.datasets.folders.open3d import PRIMESENSE
from slam.types import Camera

Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Path:
    return export("open3d", tiny_walk)


def change(file: Path, **values: object) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def test_two_frames_see_the_same_surfaces_at_the_same_place(
    export: Export, walk: Any, disagreement: Callable[..., Any], opened: Opened
) -> None:
    off_m = disagreement(opened(export("open3d", walk)), 0, 4)
    assert len(off_m) > 30_000
    assert np.median(np.abs(off_m)) < 0.004


def test_what_open3d_writes_is_read(tiny: Path, tiny_walk: Any, opened: Opened) -> None:
    for name in ("camera_intrinsic.json", "trajectory.log"):
        (tiny / name).unlink()
    intrinsic = o3d.camera.PinholeCameraIntrinsic(32, 24, 30.0, 31.0, 15.5, 11.25)
    o3d.io.write_pinhole_camera_intrinsic(str(tiny / "intrinsic.json"), intrinsic)
    trajectory = o3d.camera.PinholeCameraTrajectory()
    poses = []
    for T_world_cam in tiny_walk.T_world_depth:
        pose = o3d.camera.PinholeCameraParameters()
        pose.intrinsic, pose.extrinsic = intrinsic, np.linalg.inv(T_world_cam)
        poses.append(pose)
    trajectory.parameters = poses
    o3d.io.write_pinhole_camera_trajectory(str(tiny / "trajectory.log"), trajectory)
    sequence = opened(tiny)
    assert sequence.camera == Camera(32, 24, 30.0, 31.0, 15.5, 11.25, depth_scale=1000.0)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.T_world_cam, tiny_walk.T_world_depth)
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, np.arange(6) / 30.0)


@pytest.mark.parametrize("name", ["color", "rgb", "image"])
def test_the_colour_folder_has_several_names(tiny: Path, name: str, opened: Opened) -> None:
    (tiny / "color").rename(tiny / name)
    frames = list(opened(tiny))
    assert [frame.rgb[0, 0, 0] for frame in frames] == list(range(6))
    np.testing.assert_allclose(frames[2].depth_m, 1.2)


def test_redwoods_names_tell_the_time(tiny: Path, opened: Opened) -> None:
    for i in range(6):
        (tiny / f"color/{i:05d}.png").rename(tiny / f"color/{i + 1:07d}-{33369 * i:012d}.png")
        (tiny / f"depth/{i:05d}.png").rename(tiny / f"depth/{i + 1:07d}-{33369 * i + 9:012d}.png")
    sequence = opened(tiny)
    np.testing.assert_allclose(sequence.timestamps_s, 0.033369 * np.arange(6))
    assert len(list(sequence)) == 6
    assert sequence.ground_truth is not None and len(sequence.ground_truth) == 6


def test_times_that_do_not_increase_are_refused(tiny: Path, fails: Fails) -> None:
    (tiny / "color/00000.png").rename(tiny / "color/00000-000000050000.png")
    assert fails(tiny, "do not increase").endswith("color")


@pytest.mark.parametrize(
    ("scale", "units_per_m"), [(1000.0, 1000.0), (0.001, 1000.0), (2000, 2000.0)]
)
def test_a_depth_scale_in_the_camera_file_is_units_per_metre_or_metres_per_unit(
    tiny: Path, scale: float, units_per_m: float, opened: Opened
) -> None:
    change(tiny / "camera_intrinsic.json", depth_scale=scale)
    assert opened(tiny).camera.depth_scale == pytest.approx(units_per_m)


def test_a_camera_file_of_ours_goes_first(tiny: Path, tiny_walk: Any, opened: Opened) -> None:
    write_camera(tiny / "camera.toml", tiny_walk.camera_in(500.0))
    assert opened(tiny).camera == tiny_walk.camera_in(500.0)
    (tiny / "camera_intrinsic.json").unlink()
    assert opened(tiny).camera == tiny_walk.camera_in(500.0)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"intrinsic_matrix": [1, 2, 3]}, "intrinsic_matrix does not have 9 numbers"),
        ({"intrinsic_matrix": "none"}, "intrinsic_matrix does not have 9 numbers"),
        ({"intrinsic_matrix": ["x"] * 9}, "camera key fx = 'x'"),
        ({"width": 0}, "camera key width = 0"),
        ({"width": None}, "camera key width = None"),
        ({"depth_scale": -1.0}, "camera key depth_scale = -1.0"),
        ({"width": 640, "height": 480}, "32x24 pixels but the camera 640x480"),
    ],
)
def test_a_camera_file_that_is_wrong_is_named(
    tiny: Path, values: dict[str, object], said: str, fails: Fails
) -> None:
    change(tiny / "camera_intrinsic.json", **values)
    fails(tiny, said)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "3"])
def test_a_camera_file_that_is_none_is_named(tiny: Path, text: str, fails: Fails) -> None:
    (tiny / "camera_intrinsic.json").write_text(text)
    assert fails(tiny, "the camera file").endswith("camera_intrinsic.json")


def test_a_key_that_is_missing_is_named(tiny: Path, fails: Fails) -> None:
    (tiny / "camera_intrinsic.json").write_text(json.dumps({"width": 32, "fx": 3.0}))
    fails(tiny, "the camera key height is missing")


def test_a_trajectory_without_a_file_is_no_truth(tiny: Path, opened: Opened) -> None:
    (tiny / "trajectory.log").unlink()
    assert opened(tiny).ground_truth is None


def test_poses_of_some_of_the_images_are_theirs_by_number(tiny: Path, opened: Opened) -> None:
    identity = "1 0 0 {} \n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    log = "".join(f"{i} {i} {i + 1}\n{identity.format(i)}" for i in (1, 2, 4))
    (tiny / "trajectory.log").write_text(log)
    truth = opened(tiny).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps_s, np.array([1, 2, 4]) / 30.0)
    assert truth.T_world_cam[:, 0, 3].tolist() == [1, 2, 4]


def test_numbers_do_not_matter_where_every_image_has_a_pose(tiny: Path, opened: Opened) -> None:
    log = (tiny / "trajectory.log").read_text()
    (tiny / "trajectory.log").write_text(re.sub(r"(?m)^\d \d \d$", "0 0 1", log))
    truth = opened(tiny).ground_truth
    assert truth is not None
    assert truth.T_world_cam[:, 0, 3].tolist() == list(range(6))


@pytest.mark.parametrize("frames", [(0, 0, 1), (2, 1, 3), (4, 5, 6), (-1, 0, 1), ()])
def test_poses_that_could_be_anyones_are_refused(
    tiny: Path, frames: tuple[int, ...], fails: Fails
) -> None:
    matrix = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (tiny / "trajectory.log").write_text("".join(f"{i} {i} {i + 1}\n{matrix}" for i in frames))
    said = fails(tiny, f"there are {len(frames)} poses for 6 images")
    assert said.endswith("trajectory.log")


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["0 0"], 'line 1 is not "i j k"'),
        (["zero 0 1"], 'line 1 is not "i j k"'),
        (["0.5 0 1"], 'line 1 is not "i j k"'),
        (["0 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0"], "after line 1 there are not four rows"),
        (["0 0 1", "1 0 0 0", "0 1 0", "0 0 1 0", "0 0 0 1"], "after line 1"),
        (["0 0 1", "1 0 0 0", "0 1 0 x", "0 0 1 0", "0 0 0 1"], "four numbers, a pose"),
        (["0 0 1", "1 0 0 0", "0 1 0 0", "0 0 9 0", "0 0 0 1"], "after line 1 is no rotation"),
    ],
)
def test_a_malformed_trajectory_is_named(
    tiny: Path, lines: list[str], said: str, fails: Fails
) -> None:
    (tiny / "trajectory.log").write_text("\n".join(lines) + "\n")
    assert fails(tiny, said).endswith("trajectory.log")


def test_poses_that_are_not_known_are_gaps(tiny: Path, opened: Opened) -> None:
    known = [f"{i} {i} {i + 1}\n1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" for i in range(6)]
    known[2] = "2 2 3\n" + 4 * "nan nan nan nan\n"
    (tiny / "trajectory.log").write_text("".join(known))
    sequence = opened(tiny)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == [0, 1, 3, 4, 5]
    assert "1 of 6 poses of trajectory.log hold no numbers" in " ".join(sequence.warnings)


@pytest.fixture(scope="module")
def primesense(take: Callable[..., Any]) -> Any:
    """Return 3 frames of the camera that Open3D's examples take for granted."""
    return take(3, PRIMESENSE)


def test_without_a_camera_it_is_the_makers_default_and_said(
    export: Export, primesense: Any, opened: Opened
) -> None:
    folder = export("open3d_sample", primesense)
    (folder / "odometry.log").write_text("0 0 1\n")  # between images: not read
    sequence = opened(folder)
    assert sequence.camera == PRIMESENSE
    (said,) = sequence.warnings
    assert "PrimeSenseDefault (fx = fy = 525, cx = 319.5, cy = 239.5, 1000 depth units" in said
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.T_world_cam, primesense.T_world_depth)
    assert (sequence.frame(1).rgb == primesense.rgb[1]).all()
    np.testing.assert_allclose(sequence.frame(1).depth_m, primesense.depth_m[1], atol=0.0006)


def test_without_a_camera_a_named_one_is_asked_for_nothing(
    export: Export, tiny_walk: Any, tmp_path: Path
) -> None:
    folder = export("open3d_sample", tiny_walk)
    write_camera(tmp_path / "mine.toml", tiny_walk.camera_in(1000.0))
    sequence = open_sequence(folder, InputConfig(camera=tmp_path / "mine.toml"))
    assert sequence.camera == tiny_walk.camera_in(1000.0)
    assert sequence.warnings == ()
    assert [frame.rgb[0, 0, 0] for frame in sequence] == list(range(6))


def test_without_a_camera_images_of_another_size_are_refused(
    export: Export, tiny_walk: Any, fails: Fails
) -> None:
    said = fails(export("open3d_sample", tiny_walk), "images of 32x24 pixels are not of Open3D's")
    assert "--input.camera FILE.toml" in said and said.endswith("open3d_sample")


def test_the_samples_camera_file_has_a_name_of_its_own(tiny: Path, opened: Opened) -> None:
    camera = opened(tiny).camera
    (tiny / "camera_intrinsic.json").rename(tiny / "camera_primesense.json")
    sequence = opened(tiny)
    assert (sequence.camera, sequence.warnings) == (camera, ())


@pytest.fixture
def realsense(export: Export, tiny_walk: Any) -> Path:
    return export("realsense", tiny_walk)


def test_frames_have_the_times_of_the_list_and_the_scale_of_the_device(
    realsense: Path, opened: Opened
) -> None:
    change(realsense / "intrinsics.json", depth_scale=0.0005)
    sequence = opened(realsense)
    assert sequence.camera.depth_scale == pytest.approx(2000.0)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0, atol=1e-6)
    for i, frame in enumerate(sequence):
        assert frame.rgb[0, 0, 0] == i
        np.testing.assert_allclose(frame.depth_m, 0.5 * (1.0 + i / 10.0), atol=1e-6)
    assert sequence.warnings == ("timestamps.csv steps by 33.3333 and was read as milliseconds",)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("timestamps.csv", "{i},{s:.6f}"),
        ("timestamps.csv", "color/{i:05d}.png,{s:.6f},7"),
        ("timestamps.txt", "{i:05d}.png {s:.6f}"),
        ("timestamps.txt", "{s:.6f}"),
    ],
)
def test_the_list_may_name_images_or_just_give_times(
    realsense: Path, name: str, line: str, opened: Opened
) -> None:
    (realsense / "timestamps.csv").unlink()
    start_s = 1700000000.0
    lines = [line.format(i=i, s=start_s + i / 15.0) for i in range(6)]
    (realsense / name).write_text("\n".join(lines))
    sequence = opened(realsense)
    np.testing.assert_allclose(sequence.timestamps_s - start_s, np.arange(6) / 15.0, atol=1e-5)
    assert sequence.warnings == ()


def test_times_out_of_order_put_the_images_in_order(realsense: Path, opened: Opened) -> None:
    (realsense / "timestamps.csv").write_text("".join(f"{i},{5 - i}e-1\n" for i in range(6)))
    sequence = opened(realsense)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [5, 4, 3, 2, 1, 0]
    assert sequence.warnings == ("timestamps.csv is not in the order of time; it was sorted",)


def test_images_without_a_time_are_left_out_and_said(realsense: Path, opened: Opened) -> None:
    (realsense / "timestamps.csv").write_text("frame,time\n0,0.0\n2,0.1\n5,0.2\n9,0.3\n")
    sequence = opened(realsense)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 2, 5]
    assert sequence.warnings == ("3 of 6 images have no line in timestamps.csv and are not used",)


def test_a_missing_depth_image_is_skipped(realsense: Path, opened: Opened) -> None:
    (realsense / "depth/00002.png").unlink()
    sequence = opened(realsense)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 1, 3, 4, 5]
    assert sequence.skipped == [(realsense / "depth/00002.png", "the file is missing")]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the list holds no time"),
        ("frame,time\n", "the list holds no time"),
        ("0,0.0\n1,soon\n", "line 2 is neither"),
        ("0,0.0\n,\n2,0.1\n", "line 2 is neither"),
        ("0.0\n,;\n0.1\n", "line 2 is neither"),
        ("0,0.0\n1,'0.1;0.2'\n", "line 2 is neither"),
        ("0,0.0\n1,nan\n", "line 2 is neither"),
        ("0,0.0,x\n1,soon,x\n", "line 2 is neither"),
        ("0,0.0\n1\n", "some lines name an image"),
        ("0,0.0\nred,0.1\n", "line 2 is neither"),
        ("0,0.0\n1.5,0.1\n", "line 2 is neither"),
        ("0.0\n0.1\n0.2\n", "there are 3 times for 6 images"),
        ("7,0.0\n8,0.1\n", "no line is of an image in color/"),
        ("0,0\n1,33000000000\n2,66000000000\n", "milliseconds, microseconds or nanoseconds are"),
    ],
)
def test_a_list_that_is_wrong_is_named(realsense: Path, text: str, said: str, fails: Fails) -> None:
    (realsense / "timestamps.csv").write_text(text)
    assert fails(realsense, said).endswith("timestamps.csv")


@pytest.mark.parametrize(
    "model", ["brown_conrady", "inverse_brown_conrady", "distortion.modified_brown_conrady"]
)
def test_the_lens_is_opencvs_however_it_is_called(
    realsense: Path, model: str, opened: Opened
) -> None:
    change(realsense / "intrinsics.json", coeffs=[0.1, -0.2, 0.001, 0.002, 0.03], model=model)
    assert opened(realsense).camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.03)


def test_another_lens_model_is_refused_unless_it_does_nothing(
    realsense: Path, fails: Fails, opened: Opened
) -> None:
    change(realsense / "intrinsics.json", model="ftheta")
    assert opened(realsense).camera.distortion == (0.0,) * 5
    change(realsense / "intrinsics.json", coeffs=[0.1, 0.0, 0.0, 0.0, 0.0])
    assert "--input.camera" in fails(realsense, "the lens model 'ftheta' is not known")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"fx": "wide"}, "camera key fx = 'wide'"),
        ({"coeffs": [0.1, 0.2]}, "camera key distortion"),
        ({"ppx": 99.0}, "cx, cy = 99"),
    ],
)
def test_a_camera_that_cannot_be_is_named(
    realsense: Path, values: dict[str, object], said: str, fails: Fails
) -> None:
    change(realsense / "intrinsics.json", **values)
    assert fails(realsense, said).endswith("intrinsics.json")

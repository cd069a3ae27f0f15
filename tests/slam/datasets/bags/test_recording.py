# SPDX-License-Identifier: Apache-2.0
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence, write_camera
from slam.datasets.cameras import FREIBURG
from slam.datasets.folders.tum import open_tum
from slam.datasets.images import read_color, read_depth
from slam.geometry import se3
from slam.types import Camera

DATA = Path(os.environ.get("LOOPCLOSE_DATA", Path(__file__).parents[5] / "shared/data"))
DESK = DATA / "rgbd_dataset_freiburg1_desk"
CONFIG = InputConfig()
COLOR, DEPTH, INFO = "/camera/rgb/image_color", "/camera/depth/image", "/camera/rgb/camera_info"
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]


def reds(sequence: Sequence) -> list[int]:
    return [int(frame.rgb[0, 0, 0]) for frame in sequence]


def test_frames_come_as_they_were_recorded(of_every_kind: Any, opened: Opened) -> None:
    of_every_kind.frames(20)
    path = of_every_kind.write()
    sequence = opened(path)
    assert (sequence.name, sequence.camera) == (path.name, of_every_kind.camera)
    assert sequence.ground_truth is None and sequence.warnings == ()
    stamps_ns = [of_every_kind.start_ns + i * of_every_kind.step_ns for i in range(20)]
    assert sequence.timestamps_s.tolist() == [stamp_ns / 10**9 for stamp_ns in stamps_ns]
    for _ in range(2):
        frames = list(sequence)
        assert len(frames) == 20
        for i, frame in enumerate(frames):
            assert frame.timestamp_s == sequence.timestamps_s[i]
            np.testing.assert_array_equal(frame.rgb, of_every_kind.color(i))
            expected = of_every_kind.depth(i).astype(np.float32) / np.float32(1000.0)
            np.testing.assert_array_equal(frame.depth_m, expected)
    assert sequence.frame(3).rgb[0, 0, 0] == 3
    assert not [each for each in threading.enumerate() if each.name.startswith("images")]


def test_the_folder_of_a_bag_may_be_called_bag(
    recorder: Callable[..., Any], opened: Opened
) -> None:
    bags = recorder("ros2")
    bags.frames(2)
    assert reds(opened(bags.write("desk.bag"))) == [0, 1]


def test_one_file_of_the_folder_of_a_bag_will_do(
    recorder: Callable[..., Any], opened: Opened
) -> None:
    bags = recorder("ros2")
    bags.frames(2)
    (file,) = bags.write().glob("*.db3")
    assert reds(opened(file)) == [0, 1]


def test_what_was_recorded_out_of_order_comes_in_the_order_of_time(
    of_every_kind: Any, opened: Opened
) -> None:
    of_every_kind.add(INFO, of_every_kind.info(of_every_kind.camera))
    for i in (4, 0, 3, 1, 2):
        for topic, encoding, pixels in (
            (DEPTH, "16UC1", of_every_kind.depth(4 - i)),
            (COLOR, "rgb8", of_every_kind.color(4 - i)),
        ):
            stamp_ns = of_every_kind.start_ns + (4 - i) * of_every_kind.step_ns
            of_every_kind.add(topic, of_every_kind.image(pixels, encoding, stamp_ns))
    sequence = opened(of_every_kind.write())
    assert reds(sequence) == list(range(5))
    np.testing.assert_allclose([f.depth_m[1, 1] for f in sequence], 1.0 + np.arange(5) / 10.0)


def test_compressed_images_are_frames_too(of_every_kind: Any, opened: Opened) -> None:
    of_every_kind.add(INFO, of_every_kind.info(of_every_kind.camera))
    for i in range(3):
        stamp_ns = of_every_kind.start_ns + i * of_every_kind.step_ns
        jpeg = of_every_kind.encoded(of_every_kind.color(i)[..., ::-1], ".jpg")
        depth = of_every_kind.depth_header() + of_every_kind.encoded(of_every_kind.depth(i))
        for topic, content, format_ in (
            (f"{COLOR}/compressed", jpeg, "rgb8; jpeg compressed bgr8"),
            (f"{DEPTH}/compressedDepth", depth, "16UC1; compressedDepth"),
        ):
            message = of_every_kind.compressed(content, format_, stamp_ns)
            of_every_kind.add(topic, message)
    sequence = opened(of_every_kind.write())
    assert sequence.camera == of_every_kind.camera
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.rgb, of_every_kind.color(i), atol=4)
        np.testing.assert_allclose(frame.depth_m[1, 1], 1.0 + i / 10.0)


def test_images_too_far_apart_in_time_are_no_frame(
    recorder: Callable[..., Any], fails: Fails
) -> None:
    bags = recorder()
    bags.frames(6)
    for i in (6, 7):
        bags.add(COLOR, bags.image(bags.color(i), "rgb8", bags.start_ns + i * bags.step_ns))
    path = bags.write()
    sequence = open_sequence(path, CONFIG)
    assert reds(sequence) == list(range(6))
    assert "2 of 8 colour images have no depth image within 0.02 s" in sequence.warnings[0]
    said = "s, allowed are 0.001 s (--input.max-time-difference-s)"
    fails(path, said, InputConfig(max_time_difference_s=0.001))


def test_the_depth_scale_and_the_camera_can_be_named(
    recorder: Callable[..., Any], tmp_path: Path
) -> None:
    bags = recorder("ros2")
    bags.frames(2)
    path = bags.write()
    sequence = open_sequence(path, InputConfig(depth_scale=500.0))
    assert sequence.camera == replace(bags.camera, depth_scale=500.0)
    assert sequence.frame(0).depth_m[1, 1] == 2.0
    other = replace(bags.camera, fx=33.0, depth_scale=250.0)
    write_camera(tmp_path / "camera.toml", other)
    sequence = open_sequence(path, InputConfig(camera=tmp_path / "camera.toml"))
    assert sequence.camera == other
    assert sequence.frame(0).depth_m[1, 1] == 4.0
    write_camera(path / "camera.toml", other)
    assert open_sequence(path, CONFIG).camera == other


def test_depth_in_metres_needs_no_scale(of_every_kind: Any) -> None:
    of_every_kind.add(INFO, of_every_kind.info(of_every_kind.camera))
    depth_m = np.full((24, 32), 1.2345, np.float32)
    of_every_kind.add(COLOR, of_every_kind.image(of_every_kind.color(0), "bgr8"))
    of_every_kind.add(DEPTH, of_every_kind.image(depth_m, "32FC1"))
    path = of_every_kind.write()
    for config in (CONFIG, InputConfig(depth_scale=5000.0)):
        frame = open_sequence(path, config).frame(0)
        np.testing.assert_array_equal(frame.depth_m, depth_m)
        assert frame.rgb[0, 0].tolist() == [200, 100, 0]


def test_a_broken_image_is_skipped_and_listed(of_every_kind: Any, opened: Opened) -> None:
    of_every_kind.frames(2)
    stamp_ns = of_every_kind.start_ns + 2 * of_every_kind.step_ns
    short = of_every_kind.image(
        of_every_kind.color(2), "rgb8", stamp_ns, data=np.zeros(5, np.uint8)
    )
    of_every_kind.add(COLOR, short)
    of_every_kind.add(DEPTH, of_every_kind.image(of_every_kind.depth(2), "16UC1", stamp_ns))
    of_every_kind.frames(2, start=3, info=False)
    path = of_every_kind.write()
    sequence = opened(path)
    assert reds(sequence) == [0, 1, 3, 4]
    (skipped,) = sequence.skipped
    assert isinstance(skipped, BrokenImage)
    assert skipped.path == path / f"camera/rgb/image_color/1305031453.{stamp_ns % 10**9}"
    assert "1 of 5 frames were skipped" in sequence.warnings[-1]


@pytest.mark.parametrize("missing", [COLOR, DEPTH, INFO])
def test_what_a_bag_lacks_is_one_line(of_every_kind: Any, missing: str, fails: Fails) -> None:
    of_every_kind.frames(2)
    of_every_kind.messages = [each for each in of_every_kind.messages if each[0] != missing]
    path = of_every_kind.write()
    said = {
        COLOR: "the bag holds no colour images that can be read",
        DEPTH: "the bag holds no depth images that can be read",
        INFO: "the bag holds no sensor_msgs/msg/CameraInfo, so its camera is not known",
    }[missing]
    assert fails(path, said).endswith(str(path))


def test_an_empty_bag_is_one_line(of_every_kind: Any, fails: Fails) -> None:
    if of_every_kind.kind == "mcap":
        of_every_kind.add("/other", of_every_kind.info(of_every_kind.camera))
    fails(of_every_kind.write(), "it has no images at all")


def test_images_of_another_size_than_the_camera_are_named(of_every_kind: Any, fails: Fails) -> None:
    of_every_kind.camera = replace(of_every_kind.camera, width=64, height=48)
    of_every_kind.add(INFO, of_every_kind.info(of_every_kind.camera))
    of_every_kind.frames(2, info=False)
    said = "a colour image has 32x24 pixels but the camera 64x48"
    assert "camera/rgb/image_color/1305031453.359684000" in fails(of_every_kind.write(), said)


def with_two_cameras(bags: Any, depth_camera: Camera, frame_id: str = "depth") -> None:
    """Add one frame of a wall 2 m before a depth camera of its own."""
    bags.add(INFO, bags.info(bags.camera))
    bags.add("/camera/depth/camera_info", bags.info(depth_camera, frame_id))
    depth = np.full((depth_camera.height, depth_camera.width), 2000, np.uint16)
    bags.add(COLOR, bags.image(bags.color(0), "rgb8"))
    bags.add(DEPTH, bags.image(depth, "16UC1", frame_id=frame_id))


def test_depth_of_another_camera_is_registered_to_colour(
    of_every_kind: Any, opened: Opened
) -> None:
    T_color_depth = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    T_depth_base = se3.exp(np.array([0.1, 0.2, 0.3, 0.0, 1.0, 0.0]))
    with_two_cameras(of_every_kind, Camera(16, 12, 15.0, 15.0, 7.5, 5.5))
    of_every_kind.add(
        "/tf_static",
        of_every_kind.transforms(
            ("base", "depth", se3.inverse(T_depth_base)),
            ("camera_rgb_optical_frame", "base", T_color_depth @ T_depth_base),
        ),
    )
    sequence = opened(of_every_kind.write())
    assert (sequence.camera.width, sequence.camera.height) == (16, 12)
    assert sequence.camera.depth_scale == 1000.0
    frame = sequence.frame(0)
    assert frame.rgb.shape == (12, 16, 3)
    np.testing.assert_allclose(frame.depth_m[6, 8], 2.5, atol=1e-5)


def test_a_lens_that_registering_does_not_regard_is_a_warning(
    recorder: Callable[..., Any], opened: Opened
) -> None:
    bags = recorder()
    bent = replace(bags.camera, fx=15.0, fy=15.0, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    with_two_cameras(bags, bent)
    bags.add("/tf", bags.transforms(("camera_rgb_optical_frame", "depth", np.eye(4))))
    sequence = opened(bags.write())
    depth_m = sequence.frame(0).depth_m
    assert np.unique(depth_m).tolist() == [0.0, 2.0]
    assert 0.1 < (depth_m > 0.0).mean() < 0.4  # at twice the focal length
    assert "as if no lens distorted" in sequence.warnings[0]


def test_depth_in_the_frame_of_colour_is_registered_whatever_its_calibration(
    recorder: Callable[..., Any], opened: Opened
) -> None:
    bags = recorder()
    with_two_cameras(bags, replace(bags.camera, fx=15.0), "camera_rgb_optical_frame")
    sequence = opened(bags.write())
    assert sequence.camera == bags.camera
    assert (sequence.frame(0).depth_m == 2.0).all()


def test_depth_in_the_frame_of_colour_is_registered_to_its_own_size(
    recorder: Callable[..., Any], opened: Opened
) -> None:
    bags = recorder()
    half = Camera(16, 12, 15.0, 15.5, 7.5, 5.5)
    with_two_cameras(bags, half, "camera_rgb_optical_frame")
    sequence = opened(bags.write())
    assert sequence.camera.fx == 15.0
    frame = sequence.frame(0)
    assert frame.rgb.shape == (12, 16, 3) and (frame.depth_m == 2.0).all()


def test_two_names_of_one_place_are_registered(
    recorder: Callable[..., Any], opened: Opened
) -> None:
    bags = recorder()
    with_two_cameras(bags, bags.camera)
    bags.add("/tf", bags.transforms(("camera_rgb_optical_frame", "depth", np.eye(4))))
    sequence = opened(bags.write())
    assert sequence.camera == bags.camera
    assert (sequence.frame(0).depth_m == 2.0).all() and sequence.warnings == ()


@pytest.mark.parametrize(
    ("name", "camera"),
    [("rgbd_dataset_freiburg1_desk", FREIBURG["1"]), ("kitchen", None)],
)
def test_the_benchmarks_own_bags_have_its_calibration(
    recorder: Callable[..., Any], opened: Opened, name: str, camera: Camera | None
) -> None:
    bags = recorder("ros1")
    openni = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, depth_scale=1000.0)
    bags.add(INFO, bags.info(openni))
    bags.add("/camera/depth/camera_info", bags.info(openni))
    bags.add(COLOR, bags.image(np.zeros((480, 640, 3), np.uint8), "rgb8"))
    bags.add(DEPTH, bags.image(np.ones((480, 640), np.float32), "32FC1"))
    sequence = opened(bags.write(name))
    assert sequence.camera == (camera or openni)
    assert (sequence.frame(0).depth_m == 1.0).all()


def test_cameras_whose_places_are_not_told_cannot_be_registered(
    of_every_kind: Any, fails: Fails, tmp_path: Path
) -> None:
    with_two_cameras(of_every_kind, replace(of_every_kind.camera, fx=25.0))
    path = of_every_kind.write()
    said = "depth is of 'depth', colour of 'camera_rgb_optical_frame', whose calibrations differ"
    assert fails(path, said).endswith(str(path))
    write_camera(tmp_path / "camera.toml", of_every_kind.camera)
    named = InputConfig(camera=tmp_path / "camera.toml")
    assert open_sequence(path, named).frame(0).depth_m[0, 0] == 2.0


def test_one_calibration_under_two_names_is_taken_for_registered(
    recorder: Callable[..., Any], opened: Opened
) -> None:
    bags = recorder()
    with_two_cameras(bags, bags.camera)
    sequence = opened(bags.write())
    assert sequence.camera == bags.camera
    assert (sequence.frame(0).depth_m == 2.0).all()
    assert "neither /tf_static nor /tf joins them" in sequence.warnings[0]


@pytest.mark.skipif(not DESK.is_dir(), reason="no copy of fr1_desk under LOOPCLOSE_DATA")
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_fr1_desk_is_the_same_from_a_bag_as_from_its_folder(
    of_every_kind: Any, encoding: str, tmp_path: Path
) -> None:
    folder = tmp_path / DESK.name
    folder.mkdir()
    of_every_kind.add(INFO, of_every_kind.info(open_tum(DESK, CONFIG).camera))
    for kind, topic in (("rgb", COLOR), ("depth", DEPTH)):
        (folder / kind).symlink_to(DESK / kind)
        lines = (DESK / f"{kind}.txt").read_text().splitlines()
        lines = [line for line in lines if "1305031453.35" < line < "1305031454"]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
        for stamp, name in map(str.split, lines):
            image = read_color(DESK / name) if kind == "rgb" else read_depth(DESK / name, 5000.0)
            assert isinstance(image, np.ndarray)
            if kind == "depth" and encoding == "16UC1":
                image = np.rint(image * 5000.0).astype(np.uint16)
            written_as = "rgb8" if kind == "rgb" else encoding
            stamp_ns = int(stamp.replace(".", "")) * 1000
            of_every_kind.add(topic, of_every_kind.image(image, written_as, stamp_ns))
    config = InputConfig(depth_scale=5000.0 if encoding == "16UC1" else None)
    expected, found = open_tum(folder, CONFIG), open_sequence(of_every_kind.write(), config)
    assert found.camera == expected.camera
    assert len(expected) == 19
    np.testing.assert_array_equal(found.timestamps_s, expected.timestamps_s)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.timestamp_s == theirs.timestamp_s
        np.testing.assert_array_equal(ours.rgb, theirs.rgb)
        np.testing.assert_array_equal(ours.depth_m, theirs.depth_m)

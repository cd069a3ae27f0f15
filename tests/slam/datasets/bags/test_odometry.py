# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from slam.config import InputConfig
from slam.datasets.bags import read_bag_odometry
from slam.geometry import se3
from slam.types import FloatArray

CONFIG = InputConfig()
OdometryFails = Callable[..., str]
T_BASE_CAM = se3.exp(np.array([0.1, 0.2, -0.3, 0.5, 0.0, 1.0]))


def pose(i: int) -> FloatArray:
    return se3.exp(np.array([0.0, 0.1 * i, 0.0, 1.0 * i, 0.0, 0.5]))


def add(bags: Any, order: list[int], topic: str = "/odom") -> None:
    for i in order:
        bags.add(topic, bags.odometry(pose(i), bags.start_ns + i * bags.step_ns))


def test_poses_come_as_they_are_in_the_order_of_time(of_every_kind: Any) -> None:
    add(of_every_kind, [0, 2, 1, 3, 3])
    odometry = read_bag_odometry(of_every_kind.write(), CONFIG)
    poses = odometry.trajectory
    stamps_ns = [of_every_kind.start_ns + i * of_every_kind.step_ns for i in range(4)]
    assert poses.timestamps_s.tolist() == [stamp_ns / 10**9 for stamp_ns in stamps_ns]
    assert poses.timestamps_s[0] == float("1305031453.359684")
    np.testing.assert_allclose(poses.T_world_cam, [pose(i) for i in range(4)], atol=1e-12)
    assert odometry.T_body_cam is None


def test_the_camera_is_found_on_the_body(of_every_kind: Any) -> None:
    bags = of_every_kind
    bags.frames(2)
    add(bags, [0, 1])
    bags.add("/tf_static", bags.transforms(("base_link", "camera_rgb_optical_frame", T_BASE_CAM)))
    odometry = read_bag_odometry(bags.write(), CONFIG)
    assert odometry.T_body_cam is not None
    np.testing.assert_allclose(odometry.T_body_cam, T_BASE_CAM, atol=1e-12)


def test_a_camera_that_nothing_fixed_joins_is_not_known(recorder: Callable[..., Any]) -> None:
    bags = recorder()
    bags.frames(2)
    for i in range(2):
        bags.add("/tf", bags.transforms(("base_link", "camera_rgb_optical_frame", pose(i))))
    add(bags, [0, 1])
    assert read_bag_odometry(bags.write(), CONFIG).T_body_cam is None


def test_of_several_cameras_that_named_is_meant(
    recorder: Callable[..., Any], odometry_fails: OdometryFails
) -> None:
    bags = recorder()
    for side in ("left", "right"):
        bags.add(f"/{side}", bags.image(bags.color(0), "rgb8", frame_id=side))
    bags.add("/tf_static", bags.transforms(("base_link", "right", T_BASE_CAM)))
    add(bags, [0, 1])
    path = bags.write()
    odometry_fails(path, "several colour images: /left, /right")
    found = read_bag_odometry(path, InputConfig(color_topic="/right"))
    assert found.T_body_cam is not None
    np.testing.assert_allclose(found.T_body_cam, T_BASE_CAM, atol=1e-12)
    assert read_bag_odometry(path, InputConfig(color_topic="/left")).T_body_cam is None
    odometry_fails(path, "--input.color-topic", InputConfig(color_topic="/none"))


@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped", "Path"])
def test_other_messages_tell_poses_too(of_every_kind: Any, kind: str) -> None:
    bags = of_every_kind
    stamps_ns = [bags.start_ns + i * bags.step_ns for i in range(3)]
    stamped = [bags.pose_stamped(pose(i), stamp_ns) for i, stamp_ns in enumerate(stamps_ns)]
    if kind == "Path":
        for end in (1, 2, 3):
            header = bags.header(stamps_ns[-1])
            bags.add("/poses", bags.make("nav_msgs/Path", header=header, poses=stamped[:end]))
    for i, message in enumerate(stamped):
        if kind == "PoseWithCovarianceStamped":
            uncertain = bags.uncertain(pose(i))
            message = bags.make(f"geometry_msgs/{kind}", header=message.header, pose=uncertain)
        if kind != "Path":
            bags.add("/poses", message)
    odometry = read_bag_odometry(bags.write(), CONFIG)
    assert odometry.trajectory.timestamps_s.tolist() == [ns / 10**9 for ns in stamps_ns]
    np.testing.assert_allclose(
        odometry.trajectory.T_world_cam, [pose(i) for i in range(3)], atol=1e-12
    )


@pytest.mark.parametrize(
    ("part", "values"),
    [
        ("orientation", {"x": np.nan}),
        ("orientation", {"w": np.inf}),
        ("orientation", {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}),
        ("position", {"z": np.nan}),
    ],
)
def test_a_pose_that_is_none_is_named_by_its_time(
    of_every_kind: Any, part: str, values: dict[str, float], odometry_fails: OdometryFails
) -> None:
    add(of_every_kind, [0, 1])
    broken = of_every_kind.odometry(pose(2), of_every_kind.start_ns)
    for name, value in values.items():
        setattr(getattr(broken.pose.pose, part), name, value)
    of_every_kind.add("/odom", broken)
    path = of_every_kind.write()
    said = odometry_fails(path, "the pose of /odom at 1305031453.359684 s is no rotation")
    assert said.endswith(str(path))


def test_a_bag_without_poses_is_refused(
    recorder: Callable[..., Any], odometry_fails: OdometryFails
) -> None:
    bags = recorder()
    bags.frames(2)
    path = bags.write()
    odometry_fails(path, "the bag holds no poses")
    bags = recorder("ros1")
    bags.add("/path", bags.make("nav_msgs/Path", header=bags.header(1), poses=[]))
    odometry_fails(bags.write(), "/path holds no pose")


def test_a_message_that_is_cut_off_is_one_line(
    of_every_kind: Any, odometry_fails: OdometryFails
) -> None:
    add(of_every_kind, [0, 1])
    *head, content = of_every_kind.messages[-1]
    of_every_kind.messages[-1] = (*head, content[:90])
    odometry_fails(of_every_kind.write(), "odom")

# SPDX-License-Identifier: Apache-2.0
"""The poses that another odometry left in a bag."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam.config import InputConfig
from slam.datasets.bags.bag import Bag, Topic, time_ns
from slam.datasets.bags.topics import choose_color, choose_odometry, image_topics
from slam.datasets.bags.transforms import fixed_transform, rigid_of
from slam.types import FloatArray, SlamError, Trajectory

_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE = "geometry_msgs/msg/PoseStamped"
_UNCERTAIN_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_PATH = "nav_msgs/msg/Path"
POSES = (_ODOMETRY, _UNCERTAIN_POSE, _POSE, _PATH)
"""Types of messages that tell poses; where a bag has several, the first is read."""


@dataclass(frozen=True)
class BagOdometry:
    """Poses of a body, and where the camera is on it.

    Attributes:
        trajectory: T_odom_body, the poses as the bag has them, often x forward and z up.
        T_body_cam: (4, 4), the camera of the colour images, whose z is forward; None where the
            messages do not name the body, or nothing fixed joins it to the camera.
    """

    trajectory: Trajectory
    T_body_cam: FloatArray | None


def read_bag_odometry(path: Path, config: InputConfig) -> BagOdometry:
    """Read the topic of Odometry, PoseWithCovarianceStamped, PoseStamped or Path of a bag.

    Poses are put in the order of the times in their headers; of equal ones the first is used. Of a
    Path, which grows, the last message is.

    Raises:
        SlamError: the bag is damaged, has no such topic or several, or a pose is not finite.
    """
    bag = Bag(path)
    topic = choose_odometry(bag, POSES, config)
    stamps_ns: list[int] = []
    T_odom_body: list[FloatArray] = []
    body = None
    for message in _posed(bag, topic):
        stamp_ns, pose = time_ns(message), _pose(message)
        T = rigid_of(pose.position, pose.orientation)
        if T is None:
            raise SlamError(
                f"the pose of {topic.name} at {stamp_ns / 10**9:.6f} s is no rotation and"
                f" translation in finite numbers: {path}"
            )
        body = body or getattr(message, "child_frame_id", None)
        stamps_ns.append(stamp_ns)
        T_odom_body.append(T)
    if not stamps_ns:
        raise SlamError(f"{topic.name} holds no pose: {path}")
    _, first = np.unique(np.array(stamps_ns, dtype=np.int64), return_index=True)
    stamps_s = np.array([stamps_ns[i] / 10**9 for i in first])
    trajectory = Trajectory(stamps_s, np.array([T_odom_body[i] for i in first]))
    return BagOdometry(trajectory, _T_body_cam(bag, body, config) if body else None)


def _posed(bag: Bag, topic: Topic) -> Iterable[Any]:
    """Return the messages of which each has a time and a pose."""
    messages = bag.messages(topic)
    if topic.type != _PATH:
        return messages
    last = deque(messages, maxlen=1)
    return last[0].poses if last else ()


def _pose(message: Any) -> Any:
    """Return the position and orientation, whether or not a covariance is with them."""
    return getattr(message.pose, "pose", message.pose)


def _T_body_cam(bag: Bag, body: str, config: InputConfig) -> FloatArray | None:
    images = image_topics(bag)
    if not images and config.color_topic is None:
        return None
    return fixed_transform(bag, body, choose_color(bag, images, config).frame_id)

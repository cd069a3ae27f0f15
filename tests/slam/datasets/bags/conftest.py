# SPDX-License-Identifier: Apache-2.0
"""Small bags of every kind, written by the library that reads them."""

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slam.config import InputConfig
from slam.datasets.bags import read_bag_odometry
from slam.geometry.se3 import to_quaternion
from slam.types import Camera, FloatArray, SlamError

KINDS = ("ros1", "ros2", "mcap")
CAMERA = Camera(32, 24, 30.0, 31.0, 15.5, 11.5, depth_scale=1000.0)
START_NS = 1305031453_359684000
STEP_NS = 33_333_000
COLOR, DEPTH, INFO = "/camera/rgb/image_color", "/camera/depth/image", "/camera/rgb/camera_info"
FRAME = "camera_rgb_optical_frame"


class Recorder:
    """Collects messages, and writes them into a bag of one of the KINDS.

    Attributes:
        camera: of the tiny frames.
        start_ns, step_ns: the time of their first colour image, and between two of them.
    """

    def __init__(self, kind: str, folder: Path) -> None:
        self.kind, self.folder = kind, folder
        self.is_ros1 = kind == "ros1"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        if self.is_ros1:
            for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
                transforms = "geometry_msgs/TransformStamped[] transforms"
                self.types.register(get_types_from_msg(transforms, name))
        self.messages: list[tuple[str, str, int, bytes]] = []
        self.camera, self.start_ns, self.step_ns = CAMERA, START_NS, STEP_NS

    def make(self, name: str, **fields: Any) -> Any:
        """Return a message of a type, which is given without the /msg/ of its name."""
        return self.types.types[name.replace("/", "/msg/")](**fields)

    def add(self, topic: str, message: Any, recorded_ns: int | None = None) -> None:
        """Put a message at the end, as recorded at the time in its header or at another one."""
        name = message.__msgtype__
        serialize = self.types.serialize_ros1 if self.is_ros1 else self.types.serialize_cdr
        if recorded_ns is None:
            recorded_ns = len(self.messages) + START_NS
        self.messages.append((topic, name, recorded_ns, bytes(serialize(message, name))))

    def write(self, name: str = "recording") -> Path:
        """Write all messages; the bag is named as its kind asks."""
        path = self.folder / name
        if self.is_ros1:
            path = path.with_suffix(".bag")
            self._fill(Writer1(path))
            return path
        plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
        self._fill(Writer2(path, version=9, storage_plugin=plugin))
        return next(path.glob("*.mcap")) if self.kind == "mcap" else path

    def _fill(self, writer: Any) -> None:
        with writer:
            topics = {(topic, type_) for topic, type_, _, _ in self.messages}
            connections = {
                each: writer.add_connection(*each, typestore=self.types) for each in sorted(topics)
            }
            for topic, type_, recorded_ns, content in self.messages:
                writer.write(connections[topic, type_], recorded_ns, content)

    def header(self, stamp_ns: int, frame_id: str = FRAME) -> Any:
        stamp = self.make(
            "builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        sequence = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame_id, **sequence)

    def image(
        self,
        pixels: np.ndarray,
        encoding: str,
        stamp_ns: int = START_NS,
        frame_id: str = FRAME,
        **fields: Any,
    ) -> Any:
        channels = pixels.shape[2] if pixels.ndim == 3 else 1
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        step = pixels.shape[1] * channels * pixels.itemsize
        height, width = pixels.shape[:2]
        values = {
            "header": self.header(stamp_ns, frame_id),
            "height": height,
            "width": width,
            "encoding": encoding,
            "is_bigendian": 0,
            "step": step,
            "data": data,
        }
        return self.make("sensor_msgs/Image", **{**values, **fields})

    def compressed(
        self, content: bytes, format_: str, stamp_ns: int = START_NS, frame_id: str = FRAME
    ) -> Any:
        return self.make(
            "sensor_msgs/CompressedImage",
            header=self.header(stamp_ns, frame_id),
            format=format_,
            data=np.frombuffer(content, np.uint8),
        )

    def info(self, camera: Camera, frame_id: str = FRAME, **fields: Any) -> Any:
        """Return a CameraInfo; fields are named as ROS 2 names them."""
        p = np.hstack([camera.matrix, np.zeros((3, 1))])
        values = {
            "d": np.array(camera.distortion),
            "k": camera.matrix.ravel(),
            "r": np.eye(3).ravel(),
            "p": p.ravel(),
            **{key: np.array(value) for key, value in fields.items() if len(key) == 1},
        }
        if self.is_ros1:
            values = {key.upper(): value for key, value in values.items()}
        roi = self.make(
            "sensor_msgs/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self.header(START_NS, frame_id),
            width=camera.width,
            height=camera.height,
            distortion_model=fields.get("distortion_model", "plumb_bob"),
            binning_x=0,
            binning_y=0,
            roi=roi,
            **values,
        )

    def transforms(self, *moves: tuple[str, str, FloatArray], old: bool = False) -> Any:
        """Return a message of (parent, child, T_parent_child)s."""
        stamped = [
            self.make(
                "geometry_msgs/TransformStamped",
                header=self.header(START_NS, parent),
                child_frame_id=child,
                transform=self.make(
                    "geometry_msgs/Transform",
                    translation=self.vector("Vector3", T),
                    rotation=self.quaternion(T),
                ),
            )
            for parent, child, T in moves
        ]
        return self.make("tf/tfMessage" if old else "tf2_msgs/TFMessage", transforms=stamped)

    def vector(self, name: str, T: FloatArray) -> Any:
        return self.make(f"geometry_msgs/{name}", **dict(zip("xyz", T[:3, 3], strict=True)))

    def quaternion(self, T: FloatArray) -> Any:
        q = to_quaternion(T[:3, :3])
        return self.make("geometry_msgs/Quaternion", **dict(zip("xyzw", q, strict=True)))

    def pose(self, T: FloatArray) -> Any:
        return self.make(
            "geometry_msgs/Pose", position=self.vector("Point", T), orientation=self.quaternion(T)
        )

    def pose_stamped(self, T: FloatArray, stamp_ns: int) -> Any:
        return self.make(
            "geometry_msgs/PoseStamped", header=self.header(stamp_ns, "odom"), pose=self.pose(T)
        )

    def uncertain(self, T: FloatArray) -> Any:
        return self.make(
            "geometry_msgs/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36)
        )

    def odometry(self, T: FloatArray, stamp_ns: int, child: str = "base_link") -> Any:
        zero = self.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make(
            "geometry_msgs/TwistWithCovariance",
            twist=self.make("geometry_msgs/Twist", linear=zero, angular=zero),
            covariance=np.zeros(36),
        )
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(stamp_ns, "odom"),
            child_frame_id=child,
            pose=self.uncertain(T),
            twist=twist,
        )

    def frames(
        self, count: int = 6, *, depth_topic: str = DEPTH, info: bool = True, start: int = 0
    ) -> None:
        """Add tiny frames: frame i is of colour (i, 100, 200), 1 + i / 10 m away, 16 bits in mm."""
        if info:
            self.add(INFO, self.info(CAMERA))
        for i in range(start, start + count):
            stamp_ns = START_NS + i * STEP_NS
            self.add(COLOR, self.image(self.color(i), "rgb8", stamp_ns))
            self.add(depth_topic, self.image(self.depth(i), "16UC1", stamp_ns + 4_000_000))

    @staticmethod
    def color(i: int) -> np.ndarray:
        return np.full((24, 32, 3), (i, 100, 200), np.uint8)

    @staticmethod
    def depth(i: int) -> np.ndarray:
        pixels = np.full((24, 32), 1000 + 100 * i, np.uint16)
        pixels[0, 0] = 0
        return pixels

    @staticmethod
    def encoded(image: np.ndarray, suffix: str = ".png") -> bytes:
        done, content = cv2.imencode(suffix, image)
        assert done
        return content.tobytes()

    @staticmethod
    def depth_header(a: float = 0.0, b: float = 0.0) -> bytes:
        """Return what compressed_depth_image_transport puts before its PNG."""
        return struct.pack("<iff", 0, a, b)


@pytest.fixture
def recorder(tmp_path: Path) -> Callable[..., Recorder]:
    return lambda kind="mcap": Recorder(kind, tmp_path)


@pytest.fixture(params=KINDS)
def of_every_kind(request: pytest.FixtureRequest, tmp_path: Path) -> Recorder:
    return Recorder(request.param, tmp_path)


@pytest.fixture
def odometry_fails() -> Callable[..., str]:
    """Return what reads odometry, and returns the one line that this is refused with."""

    def refused(path: Path, said: str, config: InputConfig | None = None) -> str:
        with pytest.raises(SlamError, match=re.escape(said)) as caught:
            read_bag_odometry(path, config or InputConfig())
        assert "\n" not in str(caught.value)
        return str(caught.value)

    return refused

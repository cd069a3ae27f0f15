# SPDX-License-Identifier: Apache-2.0
"""Small good files of binary kinds that no library here writes in one call."""

import io
import struct
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_STEP_NS = 33_333_333
_FRAMES = 3
_WIDTH, _HEIGHT = 16, 12


def exr_of(depth_m: NDArray[np.float32]) -> bytes:
    """Return an OpenEXR image, not compressed, of one channel."""
    height, width = depth_m.shape
    channel = b"R\0" + struct.pack("<iIii", 2, 0, 1, 1) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    for name, kind, value in (
        (b"channels", b"chlist", channel),
        (b"compression", b"compression", b"\0"),
        (b"dataWindow", b"box2i", window),
    ):
        header += name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value
    header += b"\0"
    rows = [struct.pack("<ii", y, 4 * width) + depth_m[y].tobytes() for y in range(height)]
    first = len(header) + 8 * height
    offsets = [first + y * len(rows[0]) for y in range(height)]
    return header + struct.pack(f"<{height}Q", *offsets) + b"".join(rows)


def archive_of() -> bytes:
    """Return a .tgz of a sequence."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name, content in {"a/rgb.txt": b"0.0 rgb/0.png\n", "a/rgb/0.png": bytes(99)}.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def caffemodel_of() -> bytes:
    """Return a network of one layer with four weights."""
    shape = _chunk(7, _chunk(1, b"\x02\x02"))
    blob = shape + _chunk(5, np.ones(4, "<f4").tobytes())
    return _chunk(100, _chunk(1, b"conv1") + _chunk(7, blob))


def _chunk(field: int, content: bytes) -> bytes:
    key = field << 3 | 2
    head = bytes([key]) if key < 128 else bytes([key & 127 | 128, key >> 7])
    return head + bytes([len(content)]) + content


def bag_of(kind: str) -> dict[str, bytes]:
    """Return the files of a ROS bag of three frames: `ros1`, `ros2` or `mcap`."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if kind == "ros1":
            _fill(Writer1(folder / "recording.bag"), is_ros1=True)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            _fill(Writer2(folder / "recording", version=9, storage_plugin=plugin), is_ros1=False)
        files = [path for path in folder.rglob("*") if path.is_file()]
        return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def _fill(writer: Any, is_ros1: bool) -> None:
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    serialize = types.serialize_ros1 if is_ros1 else types.serialize_cdr

    def make(name: str, **fields: Any) -> Any:
        return types.types[name.replace("/", "/msg/")](**fields)

    def header(time_ns: int) -> Any:
        stamp = make("builtin_interfaces/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return make("std_msgs/Header", stamp=stamp, frame_id="c", **({"seq": 0} if is_ros1 else {}))

    def image(encoding: str, bytes_a_pixel: int, time_ns: int) -> Any:
        data = np.full(_WIDTH * _HEIGHT * bytes_a_pixel, 5, np.uint8)
        size = {"height": _HEIGHT, "width": _WIDTH, "step": _WIDTH * bytes_a_pixel}
        fields = {**size, "encoding": encoding, "is_bigendian": 0, "data": data}
        return make("sensor_msgs/Image", header=header(time_ns), **fields)

    def info(time_ns: int) -> Any:
        K = np.array([15.0, 0, 8, 0, 15, 6, 0, 0, 1])
        P = np.array([15.0, 0, 8, 0, 0, 15, 6, 0, 0, 0, 1, 0])
        values = {"d": np.zeros(5), "k": K, "r": np.eye(3).ravel(), "p": P}
        values = {name.upper() if is_ros1 else name: value for name, value in values.items()}
        corner = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        roi = make("sensor_msgs/RegionOfInterest", **corner)
        fields = {"distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0, "roi": roi}
        size = {"height": _HEIGHT, "width": _WIDTH}
        return make("sensor_msgs/CameraInfo", header=header(time_ns), **size, **fields, **values)

    with writer:
        connections = {}
        for i in range(_FRAMES):
            time_ns = 10**18 + i * _STEP_NS
            for topic, message in (
                ("/camera/color/image_raw", image("rgb8", 3, time_ns)),
                ("/camera/depth/image_raw", image("16UC1", 2, time_ns)),
                ("/camera/color/camera_info", info(time_ns)),
            ):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=types)
                writer.write(connections[topic], time_ns, bytes(serialize(message, kind)))

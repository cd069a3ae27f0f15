# SPDX-License-Identifier: Apache-2.0
"""The camera that a CameraInfo message describes."""

from pathlib import Path
from typing import Any

from slam.datasets.cameras import FREIBURG, UNITS_PER_M, camera_of
from slam.types import Camera, SlamError

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_MODELS = ("plumb_bob", "rational_polynomial")
_COEFFICIENTS = 5
_PINHOLE = ("width", "height", "fx", "fy", "cx", "cy")


def camera_of_info(message: Any, path: Path, *, is_rectified: bool = False) -> Camera:
    """Return the camera of a message's K and D, or, of rectified images, of its P.

    Where it is a camera of the TUM RGB-D benchmark, that one is returned, with what the message has
    no word for; of any other, depth is taken to be in millimetres.

    Raises:
        SlamError: the lens is of another model than OpenCV's, or a value is out of range.
    """
    # ROS 1 writes K, D and P, ROS 2 k, d and p.
    k, d, p = (
        [float(value) for value in getattr(message, key, getattr(message, key.lower(), ()))]
        for key in "KDP"
    )
    fx, cx, fy, cy = k[0], k[2], k[4], k[5]
    if is_rectified:
        d = []
        if p[0]:
            fx, cx, fy, cy = p[0], p[2], p[5], p[6]
    if any(d) and (message.distortion_model not in _MODELS or any(d[_COEFFICIENTS:])):
        raise SlamError(
            f"the lens model {message.distortion_model!r} with {len(d)} coefficients is not known,"
            " only k1, k2, p1, p2, k3 of plumb_bob are; name the camera by --input.camera"
            f" FILE.toml: {path}"
        )
    values: dict[str, object] = {
        "width": int(message.width),
        "height": int(message.height),
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "depth_scale": UNITS_PER_M,
    }
    if any(d):
        values["distortion"] = d[:_COEFFICIENTS]
    camera = camera_of(values, path)
    for known in FREIBURG.values():
        if is_same_pinhole(known, camera) and known.distortion == camera.distortion:
            return known
    return camera


def is_same_pinhole(one: Camera, other: Camera) -> bool:
    """Return whether two cameras see a point without distortion at the same pixel."""
    return all(getattr(one, name) == getattr(other, name) for name in _PINHOLE)

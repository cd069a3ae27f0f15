# SPDX-License-Identifier: Apache-2.0
"""A bag's colour and depth images as a recording."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage
from slam.config import InputConfig
from slam.datasets.bags.bag import Bag, Topic
from slam.datasets.bags.camera_info import camera_of_info, is_same_pinhole
from slam.datasets.bags.image_messages import color_image, depth_image
from slam.datasets.bags.messages import Messages
from slam.datasets.bags.topics import (
    ImageTopic,
    camera_infos_beside,
    choose_camera_info,
    choose_color,
    choose_depth,
    image_topics,
)
from slam.datasets.bags.transforms import fixed_transform
from slam.datasets.cameras import (
    UNITS_PER_M,
    freiburg_camera,
    is_freiburg,
    named_camera,
    rescaled,
)
from slam.datasets.folders.tum import pair_in_time
from slam.datasets.registration import Registration
from slam.datasets.sequence import ImagePair, Sequence
from slam.types import Camera, FloatArray, SlamError

# What OpenNI's driver says of every camera: that of the benchmark's bags was calibrated later.
_OPENNI = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, depth_scale=UNITS_PER_M)


def open_bag(path: Path, config: InputConfig) -> Sequence:
    """Open a ROS 1 bag, the folder of a ROS 2 bag, or an MCAP file.

    Times are those in the headers. Where a camera is named, or colour and depth say that they are
    of one frame and one calibration, they are taken to be registered.
    """
    warnings: list[str] = []
    bag = Bag(path)
    images = image_topics(bag)
    color = choose_color(bag, images, config)
    depth = choose_depth(bag, images, color, config)
    registration = None
    camera = named_camera(path, config)
    if camera is None:
        camera = _read_camera(bag, choose_camera_info(bag, color, config), color)
        if not depth.is_in_metres:
            camera = replace(camera, depth_scale=UNITS_PER_M)
        registration = _registration(bag, color, depth, camera, warnings)
    colors = Messages(path, color.topic, warnings)
    depths = Messages(path, depth.topic, warnings)
    pairs = pair_in_time(
        colors.stamps_s, depths.stamps_s, config.max_time_difference_s, path, warnings
    )
    camera = rescaled(registration.camera if registration else camera, config)
    return Sequence(
        path.resolve().name,
        camera,
        [ImagePair(float(colors.stamps_s[i]), colors.paths[i], depths.paths[k]) for i, k in pairs],
        warnings=tuple(warnings),
        registration=registration,
        read_color_file=partial(_read_color, messages=colors),
        read_depth_file=partial(_read_depth, messages=depths, depth_scale=camera.depth_scale),
        images_are_files=False,
    )


def _read_camera(bag: Bag, topic: Topic, images: ImageTopic) -> Camera:
    """Return the camera that made the images, by the topic of its calibration."""
    path = bag.path / topic.name.lstrip("/")
    message = next(bag.messages(topic), None)
    if message is None:
        raise SlamError(f"the topic of the camera's calibration is empty: {path}")
    is_rectified = "image_rect" in images.plain_name.name
    camera = camera_of_info(message, path, is_rectified=is_rectified)
    if camera == _OPENNI and is_freiburg(bag.path):
        return freiburg_camera(bag.path)
    return camera


def _registration(
    bag: Bag, color: ImageTopic, depth: ImageTopic, camera: Camera, warnings: list[str]
) -> Registration | None:
    """Return how depth is to be registered to colour; None where it is already.

    Raises:
        SlamError: it is not, and the bag does not tell where the cameras are.
    """
    beside = camera_infos_beside(bag, depth)
    depth_camera = _read_camera(bag, beside[0], depth) if len(beside) == 1 else camera
    depth_camera = replace(depth_camera, depth_scale=camera.depth_scale)
    is_same = is_same_pinhole(camera, depth_camera)
    frames = f"depth is of {depth.frame_id!r}, colour of {color.frame_id!r}"
    T_color_depth: FloatArray | None = np.eye(4)
    if color.frame_id != depth.frame_id and color.frame_id and depth.frame_id:
        T_color_depth = fixed_transform(bag, color.frame_id, depth.frame_id)
    elif (camera.width, camera.height) == (depth_camera.width, depth_camera.height):
        # No two cameras have one place. What drivers that register depth say of its focal length
        # is often that of a camera of this make.
        return None
    if T_color_depth is None and is_same:
        warnings.append(
            f"{frames}, and neither /tf_static nor /tf joins them; depth is taken to be registered"
            " to colour, as both have one calibration"
        )
        return None
    if T_color_depth is None:
        raise SlamError(
            f"{frames}, whose calibrations differ and which neither /tf_static nor /tf joins: depth"
            " cannot be registered to colour; name a topic of registered depth by"
            " --input.depth-topic, or, if it is registered, the camera by --input.camera"
            f" FILE.toml: {bag.path}"
        )
    if is_same and np.array_equal(T_color_depth, np.eye(4)):
        return None
    if any((*camera.distortion, *depth_camera.distortion)):
        warnings.append(
            "depth is registered to colour as if no lens distorted, but one does: depth may be of"
            " a place some pixels beside"
        )
    return Registration(camera, depth_camera, T_color_depth)


def _read_color(path: Path, messages: Messages) -> NDArray[np.uint8] | BrokenImage:
    message = messages.read(path)
    return message if isinstance(message, BrokenImage) else color_image(message, path)


def _read_depth(
    path: Path, messages: Messages, depth_scale: float
) -> NDArray[np.float32] | BrokenImage:
    message = messages.read(path)
    return message if isinstance(message, BrokenImage) else depth_image(message, path, depth_scale)

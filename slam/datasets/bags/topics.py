# SPDX-License-Identifier: Apache-2.0
"""Which of a bag's topics to read: those of the right type, or those that the user names."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from slam.config import InputConfig
from slam.datasets.bags.bag import Bag, Topic
from slam.datasets.bags.camera_info import CAMERA_INFO
from slam.datasets.bags.image_messages import (
    COMPRESSED_IMAGE,
    IMAGE,
    READABLE,
    Kind,
    encoding_of,
    is_grey,
    is_in_metres,
    kind_of,
)
from slam.types import SlamError

# Of drivers of RealSense, of OpenNI and ZED, and of Azure Kinect, for depth as colour sees it.
_REGISTERED = ("aligned_depth_to_color", "depth_registered", "depth_to_rgb")
_MOST_LISTED = 8


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images, by its first message.

    Attributes:
        topic: the topic.
        kind: which images it holds, None if they cannot be read.
        encoding: what ROS calls their format.
        is_grey: whether they have no colour.
        is_in_metres: whether their depth is, whatever the depth scale.
        frame_id: the camera's frame.
    """

    topic: Topic
    kind: Kind | None
    encoding: str
    is_grey: bool
    is_in_metres: bool
    frame_id: str

    @property
    def plain_name(self) -> PurePosixPath:
        """The name of the topic whose images are compressed here, or are as they are."""
        name = PurePosixPath(self.topic.name)
        return name.parent if name.name in ("compressed", "compressedDepth") else name


def image_topics(bag: Bag) -> list[ImageTopic]:
    """Return the topics of images that have any, by name."""
    found = []
    for topic in bag.of_types(IMAGE, COMPRESSED_IMAGE):
        message = next(bag.messages(topic), None)
        if message is not None:
            found.append(
                ImageTopic(
                    topic,
                    kind=kind_of(message),
                    encoding=encoding_of(message),
                    is_grey=is_grey(message),
                    is_in_metres=is_in_metres(message),
                    frame_id=str(message.header.frame_id).lstrip("/"),
                )
            )
    return found


def choose_color(bag: Bag, images: list[ImageTopic], config: InputConfig) -> ImageTopic:
    """Return the topic of the colour images.

    Raises:
        SlamError: there is none, or there are several and the user names none.
    """
    return _choose_images(bag, images, "colour", config.color_topic, [lambda each: each.is_grey])


def choose_depth(
    bag: Bag, images: list[ImageTopic], color: ImageTopic, config: InputConfig
) -> ImageTopic:
    """Return the topic of the depth images, best of depth registered to colour.

    Raises:
        SlamError: there is none, or there are several and the user names none.
    """
    worse: list[Callable[[ImageTopic], Any]] = [
        lambda each: each.encoding == "mono16",  # which is mostly infrared
        lambda each: not any(word in each.topic.name for word in _REGISTERED),
        lambda each: -_shared_parts(each.plain_name, color.plain_name),
    ]
    return _choose_images(bag, images, "depth", config.depth_topic, worse)


def _choose_images(
    bag: Bag,
    images: list[ImageTopic],
    kind: Kind,
    named: str | None,
    worse: list[Callable[[ImageTopic], Any]],
) -> ImageTopic:
    setting = f"--input.{'color' if kind == 'colour' else kind}-topic"
    fitting = [each for each in images if each.kind == kind]
    if named is not None:
        chosen = next((each for each in images if _is_named(each.topic, named)), None)
        if chosen is None or chosen.kind != kind:
            has = f"is of {chosen.encoding!r}" if chosen else "is none of its topics of images"
            raise SlamError(
                f"{named} ({setting}) {has}; {kind} is read from {READABLE[kind]}; {_held(images)}:"
                f" {bag.path}"
            )
        return chosen
    if not fitting:
        raise SlamError(
            f"the bag holds no {kind} images that can be read ({READABLE[kind]}); {_held(images)}:"
            f" {bag.path}"
        )
    # Sent both as they are and compressed, images are the same.
    plain = {PurePosixPath(each.topic.name) for each in fitting}
    fitting = [
        each
        for each in fitting
        if each.plain_name not in plain or str(each.plain_name) == each.topic.name
    ]
    for badness in worse:
        least = min(badness(each) for each in fitting)
        fitting = [each for each in fitting if badness(each) == least]
    if len(fitting) > 1:
        raise SlamError(_several(f"{kind} images", [each.topic for each in fitting], setting, bag))
    return fitting[0]


def choose_camera_info(bag: Bag, color: ImageTopic, config: InputConfig) -> Topic:
    """Return the topic of the colour camera's calibration.

    Raises:
        SlamError: there is none, or there are several and the user names none.
    """
    found, setting = bag.of_types(CAMERA_INFO), "--input.camera-info-topic"
    if not found:
        raise SlamError(
            f"the bag holds no {CAMERA_INFO}, so its camera is not known; name it by"
            f" --input.camera FILE.toml: {bag.path}"
        )
    if config.camera_info_topic is None:
        found = camera_infos_beside(bag, color)
    return _choose(bag, found, "calibrations", config.camera_info_topic, setting)


def camera_infos_beside(bag: Bag, images: ImageTopic) -> list[Topic]:
    """Return the topics of calibrations whose names have most in common with the images'."""
    found = bag.of_types(CAMERA_INFO)
    shared = [_shared_parts(PurePosixPath(each.name), images.plain_name) for each in found]
    return [each for each, parts in zip(found, shared, strict=True) if parts == max(shared)]


def choose_odometry(bag: Bag, types: Iterable[str], config: InputConfig) -> Topic:
    """Return the topic of the poses, of the first of the types of which there is any.

    Raises:
        SlamError: there is none, or there are several and the user names none.
    """
    types, setting = list(types), "--input.odometry-topic"
    found = bag.of_types(*types)
    if not found:
        raise SlamError(f"the bag holds no poses ({', '.join(types)}): {bag.path}")
    if config.odometry_topic is None:
        best = next(each for each in types if bag.of_types(each))
        found = bag.of_types(best)
    return _choose(bag, found, "poses", config.odometry_topic, setting)


def _choose(bag: Bag, found: list[Topic], what: str, named: str | None, setting: str) -> Topic:
    if named is not None:
        chosen = next((each for each in found if _is_named(each, named)), None)
        if chosen is None:
            names = ", ".join(each.name for each in found[:_MOST_LISTED])
            raise SlamError(f"{named} ({setting}) holds no {what}; {names} would: {bag.path}")
        return chosen
    if len(found) > 1:
        raise SlamError(_several(what, found, setting, bag))
    return found[0]


def _several(what: str, topics: list[Topic], setting: str, bag: Bag) -> str:
    names = ", ".join(topic.name for topic in topics)
    return f"the bag holds several {what}: {names}; name one by {setting}: {bag.path}"


def _held(images: list[ImageTopic]) -> str:
    if not images:
        return "it has no images at all"
    held = ", ".join(f"{each.topic.name} of {each.encoding!r}" for each in images[:_MOST_LISTED])
    return f"it has {held}"


def _is_named(topic: Topic, name: str) -> bool:
    return topic.name.strip("/") == name.strip("/")


def _shared_parts(one: PurePosixPath, other: PurePosixPath) -> int:
    pairs = list(zip(one.parts, other.parts, strict=False))
    return next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))

# SPDX-License-Identifier: Apache-2.0
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from slam.config import InputConfig
from slam.datasets.bags.bag import Bag
from slam.datasets.bags.odometry import POSES
from slam.datasets.bags.topics import (
    camera_infos_beside,
    choose_camera_info,
    choose_color,
    choose_depth,
    choose_odometry,
    image_topics,
)
from slam.types import SlamError

CONFIG = InputConfig()
Setup = Callable[..., Bag]


@pytest.fixture
def holding(recorder: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Setup:
    """Return what writes a bag with a message on each of the topics, of the encoding named."""

    def written(**encodings: str) -> Bag:
        bags = recorder("ros2")
        bags.folder = tmp_path_factory.mktemp("bag")
        pixels = {"rgb8": bags.color(0), "mono8": bags.color(0)[..., 0], "yuv": bags.color(0)}
        for name, encoding in encodings.items():
            topic = "/" + name.replace("__", "/")
            if encoding == "info":
                bags.add(topic, bags.info(bags.camera))
            elif encoding == "pose":
                bags.add(topic, bags.pose_stamped(np.eye(4), bags.start_ns))
            elif encoding == "odometry":
                bags.add(topic, bags.odometry(np.eye(4), bags.start_ns))
            elif encoding == "jpeg":
                bags.add(topic, bags.compressed(bags.encoded(bags.color(0), ".jpg"), "jpeg"))
            elif encoding == "compressedDepth":
                content = bags.depth_header() + bags.encoded(bags.depth(0))
                bags.add(topic, bags.compressed(content, "16UC1; compressedDepth"))
            else:
                bags.add(topic, bags.image(pixels.get(encoding, bags.depth(0)), encoding))
        return Bag(bags.write())

    return written


def color_of(bag: Bag, config: InputConfig = CONFIG) -> str:
    return choose_color(bag, image_topics(bag), config).topic.name


def depth_of(bag: Bag, config: InputConfig = CONFIG) -> str:
    images = image_topics(bag)
    return choose_depth(bag, images, choose_color(bag, images, config), config).topic.name


def info_of(bag: Bag, config: InputConfig = CONFIG) -> str:
    return choose_camera_info(bag, choose_color(bag, image_topics(bag), config), config).name


def refused(choose: Callable[..., Any], said: str, *arguments: Any) -> str:
    with pytest.raises(SlamError, match=re.escape(said)) as caught:
        choose(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_colour_and_depth_are_told_apart_by_their_encoding(holding: Setup) -> None:
    bag = holding(a="16UC1", b="rgb8", c="yuv")
    assert color_of(bag) == "/b"
    assert depth_of(bag) == "/a"


@pytest.mark.parametrize(
    "others",
    [
        {"cam__infra1__image": "mono8", "cam__infra2__image": "mono8"},
        {"cam__rgb__image__compressed": "jpeg"},
    ],
)
def test_one_topic_of_colour_goes_before_grey_and_before_its_own_compressed_images(
    holding: Setup, others: dict[str, str]
) -> None:
    assert color_of(holding(cam__rgb__image="rgb8", **others)) == "/cam/rgb/image"


def test_grey_or_compressed_images_alone_will_do(holding: Setup) -> None:
    bag = holding(
        left__image="mono8", left__depth="16UC1", left__depth__compressedDepth="compressedDepth"
    )
    assert (color_of(bag), depth_of(bag)) == ("/left/image", "/left/depth")
    bag = holding(c__compressed="jpeg", d__compressedDepth="compressedDepth")
    assert (color_of(bag), depth_of(bag)) == ("/c/compressed", "/d/compressedDepth")


@pytest.mark.parametrize(
    "topics",
    [
        {"left__image": "rgb8", "right__image": "rgb8"},
        {"left__image": "rgb8", "right__image__compressed": "jpeg"},
        {"left__image": "mono8", "right__image": "mono8"},
    ],
)
def test_several_colour_topics_are_listed_with_the_setting(
    holding: Setup, topics: dict[str, str]
) -> None:
    bag = holding(**topics)
    names = ", ".join("/" + name.replace("__", "/") for name in topics)
    said = refused(
        color_of, f"several colour images: {names}; name one by --input.color-topic", bag
    )
    assert said.endswith(str(bag.path))
    second = names.split(", ")[1]
    for name in (second, second.lstrip("/")):
        assert color_of(bag, InputConfig(color_topic=name)) == second


@pytest.mark.parametrize(
    "registered",
    ["cam__aligned_depth_to_color__image_raw", "cam__depth_registered__image", "depth_to_rgb__raw"],
)
def test_depth_registered_to_colour_goes_first(holding: Setup, registered: str) -> None:
    bag = holding(**{"cam__color__raw": "rgb8", "cam__color__depth": "16UC1", registered: "16UC1"})
    assert depth_of(bag) == "/" + registered.replace("__", "/")


def test_depth_is_that_of_the_colour_camera(holding: Setup) -> None:
    topics = {f"{side}__{kind}": e for side in "ab" for kind, e in (("c", "rgb8"), ("d", "16UC1"))}
    bag = holding(**topics)
    assert depth_of(bag, InputConfig(color_topic="/b/c")) == "/b/d"
    assert depth_of(bag, InputConfig(color_topic="/b/c", depth_topic="/a/d")) == "/a/d"


def test_infrared_is_not_taken_for_depth(holding: Setup) -> None:
    assert depth_of(holding(rgb="rgb8", depth="16UC1", ir="mono16")) == "/depth"


def test_several_depth_topics_are_listed_with_the_setting(holding: Setup) -> None:
    bag = holding(cam__rgb="rgb8", cam__depth__image="32FC1", cam__depth__image_raw="16UC1")
    said = "several depth images: /cam/depth/image, /cam/depth/image_raw; name one by --input.depth"
    refused(depth_of, said, bag)
    config = InputConfig(depth_topic="/cam/depth/image")
    assert depth_of(bag, config) == "/cam/depth/image"


def test_what_is_missing_is_said_with_what_there_is(holding: Setup) -> None:
    said = "holds no colour images that can be read (rgb8, bgr8, rgba8, bgra8, mono8, jpeg or png)"
    assert "it has /a of 'yuv', /b of '16UC1'" in refused(
        color_of, said, holding(a="yuv", b="16UC1")
    )
    assert "no images at all" in refused(color_of, said, holding(info="info"))
    refused(depth_of, "holds no depth images that can be read (16UC1,", holding(a="rgb8"))


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ("/c", "/c (--input.color-topic) is of 'yuv'; colour is read from rgb8,"),
        ("/b", "/b (--input.color-topic) is of '16UC1'; colour is read from rgb8,"),
        ("/none", "/none (--input.color-topic) is none of its topics of images; colour is read"),
        ("/info", "/info (--input.color-topic) is none of its topics of images; colour is read"),
    ],
)
def test_a_topic_that_is_named_must_fit(holding: Setup, named: str, said: str) -> None:
    bag = holding(a="rgb8", b="16UC1", c="yuv", info="info")
    refused(color_of, said, bag, InputConfig(color_topic=named))
    refused(depth_of, "(--input.depth-topic) is of 'yuv'", bag, InputConfig(depth_topic="/c"))


def test_the_calibration_is_that_beside_the_images(holding: Setup) -> None:
    for name in ("rgb__image", "rgb__image__compressed"):
        encoding = "jpeg" if "compressed" in name else "rgb8"
        bag = holding(**{name: encoding}, rgb__camera_info="info", depth__camera_info="info")
        assert info_of(bag) == "/rgb/camera_info"
        named = InputConfig(camera_info_topic="/depth/camera_info")
        assert info_of(bag, named) == "/depth/camera_info"


def test_a_calibration_is_found_where_librealsense_puts_it(holding: Setup) -> None:
    bag = holding(
        device_0__sensor_0__Depth_0__image__data="16UC1",
        device_0__sensor_0__Depth_0__info__camera_info="info",
        device_0__sensor_1__Color_0__image__data="rgb8",
        device_0__sensor_1__Color_0__info__camera_info="info",
    )
    assert info_of(bag) == "/device_0/sensor_1/Color_0/info/camera_info"


def test_another_calibration_serves_if_it_is_the_only_one(holding: Setup) -> None:
    assert info_of(holding(rgb__image="rgb8", elsewhere="info")) == "/elsewhere"
    bag = holding(rgb__image="rgb8", one="info", two="info")
    refused(info_of, "several calibrations: /one, /two; name one by --input.camera-info-topic", bag)
    bag = holding(rgb__image="rgb8", rgb__camera_info="rgb8")
    config = InputConfig(color_topic="/rgb/image")
    images = image_topics(bag)
    assert camera_infos_beside(bag, choose_color(bag, images, config)) == []
    refused(info_of, "--input.camera FILE.toml", bag, config)
    named = InputConfig(camera_info_topic="/three")
    bag = holding(rgb__image="rgb8", one="info", two="info")
    said = "/three (--input.camera-info-topic) holds no calibrations; /one, /two would"
    refused(info_of, said, bag, named)


def test_odometry_is_taken_before_other_poses(holding: Setup) -> None:
    bag = holding(pose="pose", odom="odometry")
    assert choose_odometry(bag, POSES, CONFIG).name == "/odom"
    assert choose_odometry(bag, POSES, InputConfig(odometry_topic="pose")).name == "/pose"
    assert choose_odometry(holding(pose="pose"), POSES, CONFIG).name == "/pose"


def test_odometry_that_is_not_told_is_listed(holding: Setup) -> None:
    bag = holding(a="odometry", b="odometry", image="rgb8")
    said = "several poses: /a, /b; name one by --input.odometry-topic"
    refused(choose_odometry, said, bag, POSES, CONFIG)
    said = "/image (--input.odometry-topic) holds no poses; /a, /b would"
    refused(choose_odometry, said, bag, POSES, InputConfig(odometry_topic="/image"))
    bag = holding(image="rgb8")
    refused(choose_odometry, "the bag holds no poses (nav_msgs/msg/Odometry,", bag, POSES, CONFIG)

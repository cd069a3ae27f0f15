# SPDX-License-Identifier: Apache-2.0
import gc
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.datasets.bags.bag import Bag, Topic, time_ns
from slam.types import SlamError

Fails = Callable[..., str]


def content(path: Path) -> Path:
    """Return the file that holds the messages."""
    return path if path.is_file() else next(path.glob("*.db3"))


def test_topics_are_named_and_typed_alike_in_every_kind_of_bag(of_every_kind: Any) -> None:
    of_every_kind.frames(2)
    bag = Bag(of_every_kind.write())
    assert list(bag.topics.values()) == [
        Topic("/camera/depth/image", "sensor_msgs/msg/Image"),
        Topic("/camera/rgb/camera_info", "sensor_msgs/msg/CameraInfo"),
        Topic("/camera/rgb/image_color", "sensor_msgs/msg/Image"),
    ]
    assert bag.of_types("sensor_msgs/msg/CameraInfo") == [bag.topics["/camera/rgb/camera_info"]]


def test_messages_come_one_by_one_from_any_time_on(of_every_kind: Any) -> None:
    of_every_kind.frames(4)
    bag = Bag(of_every_kind.write())
    topic = bag.topics["/camera/rgb/image_color"]
    reds = [int(message.data[0]) for message in bag.messages(topic)]
    assert reds == [0, 1, 2, 3]
    recorded_ns = [recorded for recorded, _ in bag.raw(topic)]
    assert recorded_ns == [of_every_kind.start_ns + i for i in (1, 3, 5, 7)]
    later = [bag.decoded(topic, raw) for _, raw in bag.raw(topic, recorded_ns[2])]
    assert [time_ns(message) for message in later] == [
        of_every_kind.start_ns + i * of_every_kind.step_ns for i in (2, 3)
    ]


def test_transforms_of_tfs_first_version_are_read(recorder: Callable[..., Any]) -> None:
    bags = recorder("ros1")
    bags.add("/tf", bags.transforms(("/base", "/camera", np.eye(4)), old=True))
    bag = Bag(bags.write())
    (topic,) = bag.of_types("tf2_msgs/msg/TFMessage")
    assert [each.child_frame_id for each in next(bag.messages(topic)).transforms] == ["/camera"]


def test_without_the_package_it_is_named(
    recorder: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, fails: Fails
) -> None:
    bags = recorder("ros1")
    bags.frames(2)
    path = bags.write()
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    said = "reading ROS bags needs the package rosbags: pip install 'loopclose[ros]'"
    assert fails(path, said) == said


def test_the_package_is_loaded_only_where_a_bag_is_opened() -> None:
    code = "import sys, slam.datasets; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "slam.datasets.bags.bag" in run.stdout.split()
    assert "rosbags" not in run.stdout.split()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_bag_that_was_cut_off_is_one_line(of_every_kind: Any, share: float, fails: Fails) -> None:
    of_every_kind.frames(4)
    path = of_every_kind.write()
    file = content(path)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    assert fails(path, "the bag is damaged, or was not closed").endswith(str(path))


@pytest.mark.parametrize("name", ["text.bag", "text.mcap", "text.db3"])
def test_a_file_that_is_no_bag_is_one_line(tmp_path: Path, name: str, fails: Fails) -> None:
    (tmp_path / name).write_text("no bag\n" * 100)
    fails(tmp_path / name, "the bag is damaged")


@pytest.mark.parametrize("text", ["", "- a list", "rosbag2_bagfile_information: {}", "a: [b\n: c"])
def test_what_is_said_of_a_folder_must_be_right(
    recorder: Callable[..., Any], text: str, fails: Fails
) -> None:
    bags = recorder("ros2")
    bags.frames(2)
    path = bags.write()
    (path / "metadata.yaml").write_text(text)
    fails(path, "the bag is damaged")


def test_a_bag_that_may_not_be_read_says_so(
    recorder: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, fails: Fails
) -> None:
    bags = recorder("ros1")
    bags.frames(2)
    path = bags.write()

    def forbidden(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", forbidden)
    fails(path, "cannot read the bag: Permission denied")


def test_a_message_of_another_type_is_one_line(of_every_kind: Any) -> None:
    of_every_kind.frames(1)
    bag = Bag(of_every_kind.write())
    with pytest.raises(SlamError, match="camera/rgb/image_color") as caught:
        bag.decoded(bag.topics["/camera/rgb/image_color"], b"\0\1\0\0short")
    assert "\n" not in str(caught.value)


def test_files_are_closed_with_the_bag(recorder: Callable[..., Any]) -> None:
    bags = recorder("ros1")
    bags.frames(1)
    bag = Bag(bags.write())
    file = bag._reader.bio
    assert not file.closed
    del bag
    assert file.closed


def test_a_bag_that_is_no_longer_read_goes_in_silence(
    recorder: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = recorder("ros2")
    bags.frames(20)
    bag: Any = Bag(bags.write())
    bag.itself = bag.messages(bag.topics["/camera/rgb/image_color"])
    next(bag.itself)
    complaints: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", complaints.append)
    del bag
    gc.collect()
    assert complaints == []

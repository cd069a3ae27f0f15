# SPDX-License-Identifier: Apache-2.0
"""A ROS 1 bag, a ROS 2 bag or an MCAP file: which topics it holds, and their messages."""

import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from placerec.errors import LoopcloseError
from placerec.files import check_file, is_file
from slam.types import SlamError

SUFFIXES = (".bag", ".mcap", ".db3")
"""Of the bags that are a file; those of ROS 2 are mostly folders."""


def is_bag(path: Path) -> bool:
    """Whether a path is that of a bag, by its name or by what its folder holds."""
    return path.suffix in SUFFIXES or is_file(path / "metadata.yaml")


_MOST_BYTES = 1 << 44  # what is asked is whether they are plain files: bags may be of any size
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
# Of tf's first version, which is laid out in the same way.
_OLD_NAMES = {"tf/msg/tfMessage": _TRANSFORMS}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag, with the type of its messages, such as sensor_msgs/msg/Image."""

    name: str
    type: str


class Bag:
    """An open bag; its messages are of the types that ROS itself brings, and decoded one by one.

    Not to be used by two threads at once, except for `decoded`.

    Attributes:
        path: where it is.
        topics: by name.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            SlamError: it is damaged, or the package that reads bags is not there.
        """
        try:
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as error:
            raise SlamError(
                "reading ROS bags needs the package rosbags: pip install 'loopclose[ros]'"
            ) from error
        for file in path.iterdir() if path.is_dir() else [path]:
            if not file.is_dir():
                check_file(file, _MOST_BYTES, kind=SlamError)
        self.path = path
        is_ros1 = path.suffix == ".bag" and not path.is_dir()
        # Types are taken from here, not from the bag: old bags of ROS 2 do not tell them.
        types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        if is_ros1:
            transforms = "geometry_msgs/TransformStamped[] transforms"
            types.register(get_types_from_msg(transforms, _TRANSFORMS))
        self._decode = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
        with _as_one_line(path):
            self._reader: Any = Reader1(path) if is_ros1 else Reader2(path)
            self._reader.open()
        weakref.finalize(self, _close, self._reader)
        self.topics = {
            each.topic: Topic(each.topic, _OLD_NAMES.get(each.msgtype, each.msgtype))
            for each in sorted(self._reader.connections, key=lambda each: str(each.topic))
        }

    def of_types(self, *types: str) -> list[Topic]:
        """Return the topics whose messages are of one of these types, by name."""
        return [topic for topic in self.topics.values() if topic.type in types]

    def raw(self, topic: Topic, start_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yield (time, content) of a topic's messages, in the order in which they were recorded.

        The time is when the message was recorded, nanoseconds; those before `start_ns` are left
        out. The content is for `decoded`.

        Raises:
            SlamError: the bag is damaged.
        """
        with _as_one_line(self.path):
            connections = [each for each in self._reader.connections if each.topic == topic.name]
            for _, time_ns, content in self._reader.messages(connections, start=start_ns):
                yield time_ns, content

    def decoded(self, topic: Topic, content: bytes) -> Any:
        """Return the message, with the attributes that its type has.

        Raises:
            SlamError: the content is not of the topic's type.
        """
        with _as_one_line(self.path / topic.name.lstrip("/")):
            return self._decode(content, topic.type)

    def messages(self, topic: Topic) -> Iterator[Any]:
        """Yield a topic's messages, in the order in which they were recorded.

        Raises:
            SlamError: the bag or a message is damaged.
        """
        for _, content in self.raw(topic):
            yield self.decoded(topic, content)


def time_ns(message: Any) -> int:
    """Return when what a message tells was so, by its header, nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _close(reader: Any) -> None:
    with suppress(Exception):  # SQLite does not close while a message is still being looked for
        reader.close()


@contextmanager
def _as_one_line(path: Path) -> Iterator[None]:
    try:
        yield
    except LoopcloseError:
        raise
    except PermissionError as error:
        raise SlamError(f"cannot read the bag: {error.strerror}: {path}") from error
    except Exception as error:  # rosbags lets through whatever broken bytes lead to
        why = " ".join(str(error).split()) or type(error).__name__
        raise SlamError(
            "the bag is damaged, or was not closed when it was recorded (`rosbag reindex` or `mcap"
            f" recover` may mend it): {why}: {path}"
        ) from error

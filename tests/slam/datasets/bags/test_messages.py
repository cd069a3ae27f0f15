# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.bags.bag import Bag
from slam.datasets.bags.messages import Messages
from slam.types import SlamError

NAME = "/camera/rgb/image_color"


def opened(path: Path) -> tuple[Messages, list[str]]:
    warnings: list[str] = []
    return Messages(path, Bag(path).topics[NAME], warnings), warnings


def reds(messages: Messages, order: list[int]) -> list[int]:
    return [int(messages.read(messages.paths[i]).data[0]) for i in order]


def test_a_time_is_the_float_that_its_decimals_are(recorder: Callable[..., Any]) -> None:
    bags = recorder()
    texts = [f"1305031453.{i:06d}" for i in range(3, 1_000_000, 9_973)]
    for text in texts:
        stamp_ns = int(text.replace(".", "")) * 1000
        bags.add(NAME, bags.image(bags.color(0), "rgb8", stamp_ns))
    messages, _ = opened(bags.write())
    assert messages.stamps_s.tolist() == [float(text) for text in texts]


def test_messages_are_in_the_order_of_the_times_in_their_headers(of_every_kind: Any) -> None:
    order = [3, 1, 0, 5, 2, 4]
    for i in order:
        stamp_ns = of_every_kind.start_ns + i * of_every_kind.step_ns
        of_every_kind.add(NAME, of_every_kind.image(of_every_kind.color(i), "rgb8", stamp_ns))
    path = of_every_kind.write()
    messages, warnings = opened(path)
    assert reds(messages, list(range(6))) == list(range(6))
    assert (np.diff(messages.stamps_s) > 0.0).all()
    assert warnings == []
    assert messages.paths[0] == path / "camera/rgb/image_color/1305031453.359684000"


@pytest.mark.parametrize("order", [[7, 2, 2, 29, 0, 28, 1], [0, 20, 10, 11, 12, 3], [5, 4, 6, 3]])
def test_any_message_can_be_read_at_any_time(of_every_kind: Any, order: list[int]) -> None:
    of_every_kind.frames(30)
    messages, _ = opened(of_every_kind.write())
    assert reds(messages, order) == order


def test_messages_recorded_at_one_time_are_not_mixed_up(of_every_kind: Any) -> None:
    for i in range(9):
        message = of_every_kind.image(of_every_kind.color(i), "rgb8", (i + 1) * 10**8)
        of_every_kind.add(NAME, message, recorded_ns=10**9 + i // 3)
    messages, _ = opened(of_every_kind.write())
    order = [5, 8, 0, 1, 7, 3]
    assert reds(messages, order) == order


def test_threads_that_overtake_each_other_read_the_right_messages(of_every_kind: Any) -> None:
    of_every_kind.frames(60)
    messages, _ = opened(of_every_kind.write())
    with ThreadPoolExecutor(4) as readers:
        found = list(readers.map(lambda i: reds(messages, [i])[0], range(60)))
    assert found == list(range(60))


def test_messages_read_in_order_are_read_once(
    recorder: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = recorder()
    bags.frames(40)
    messages, _ = opened(bags.write())
    starts: list[int | None] = []
    raw = messages._bag.raw

    def counted(topic: Any, start_ns: int | None = None) -> Any:
        starts.append(start_ns)
        return raw(topic, start_ns)

    monkeypatch.setattr(messages._bag, "raw", counted)
    assert reds(messages, list(range(0, 40, 2))) == list(range(0, 40, 2))
    assert len(starts) == 1
    assert len(messages._recent) < 10  # the bag is not in memory


def test_what_cannot_be_used_is_counted(of_every_kind: Any) -> None:
    of_every_kind.frames(5)
    again = of_every_kind.image(of_every_kind.color(99), "rgb8", of_every_kind.start_ns)
    of_every_kind.add(NAME, again)
    of_every_kind.add(NAME, of_every_kind.image(of_every_kind.color(98), "rgb8", 0))
    topic, type_, recorded_ns, content = of_every_kind.messages[-1]
    of_every_kind.messages.append((topic, type_, recorded_ns + 1, content[:30]))
    messages, warnings = opened(of_every_kind.write())
    assert reds(messages, list(range(5))) == list(range(5))
    assert len(messages.paths) == len(messages.stamps_s) == 5
    assert warnings[0].startswith(f"3 of 8 messages of {NAME} are damaged, or have no time")


def test_messages_without_any_time_are_refused(of_every_kind: Any) -> None:
    for _ in range(3):
        of_every_kind.add(NAME, of_every_kind.image(of_every_kind.color(0), "rgb8", 0))
    path = of_every_kind.write()
    with pytest.raises(SlamError, match="no message has a time in its header"):
        opened(path)


def test_a_message_that_breaks_later_is_an_answer(
    recorder: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = recorder()
    bags.frames(3)
    messages, _ = opened(bags.write())
    monkeypatch.setattr(messages, "_content", lambda number: b"\0\1\0\0short")
    path = messages.paths[1]
    assert messages.read(path) == BrokenImage(path, "the message is damaged")


def test_a_bag_that_shrinks_meanwhile_is_said(
    recorder: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = recorder()
    bags.frames(3)
    messages, _ = opened(bags.write())
    monkeypatch.setattr(messages._bag, "raw", lambda topic, start_ns=None: iter(()))
    with pytest.raises(SlamError, match="no longer holds the message"):
        messages.read(messages.paths[1])

# SPDX-License-Identifier: Apache-2.0
"""The messages of one topic of a bag, read by their names, mostly one after the other."""

import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from placerec.datasets.images import BrokenImage
from slam.datasets.bags.bag import Bag, Topic, time_ns
from slam.types import FloatArray, SlamError

_KEPT = 6  # so many passed by are at hand for a thread that comes late
_NEAR = 8  # messages to be passed over rather than looked for anew


class Messages:
    """The messages of a topic, ordered by the time in their headers: each is named by a path.

    The path is no file: it is the bag's, the topic's name and the time, for people to find it.

    Attributes:
        paths: N names.
        stamps_s: (N,) float64, strictly increasing.
    """

    def __init__(self, path: Path, topic: Topic, warnings: list[str]) -> None:
        """Read the times of all messages; what cannot be used goes to the warnings.

        Raises:
            SlamError: the bag is damaged, or no message tells its time.
        """
        self._bag, self._topic = Bag(path), topic
        self._lock = threading.Lock()
        self._recent: deque[tuple[int, bytes]] = deque(maxlen=_KEPT)
        self._ahead: Iterator[tuple[int, tuple[int, bytes]]] = iter(())
        recorded_ns, stamps_ns = self._read_times()
        self._recorded_ns = np.array(recorded_ns, dtype=np.int64)
        # Of what comes twice, the first; divided as whole numbers, a time is the float nearest to
        # its decimals, as where it is read from text.
        first = {stamp_ns: i for i, stamp_ns in reversed(list(enumerate(stamps_ns))) if stamp_ns}
        self.stamps_s: FloatArray = np.array([stamp_ns / 10**9 for stamp_ns in sorted(first)])
        folder = path / topic.name.lstrip("/")
        names = {f"{ns // 10**9}.{ns % 10**9:09d}": first[ns] for ns in sorted(first)}
        self._numbers = {folder / name: number for name, number in names.items()}
        self.paths = list(self._numbers)
        if not first:
            raise SlamError(f"no message has a time in its header: {folder}")
        if unusable := len(stamps_ns) - len(first):
            warnings.append(
                f"{unusable} of {len(stamps_ns)} messages of {topic.name} are damaged, or have no"
                " time in their header or one that came before; they are not used"
            )

    def read(self, path: Path) -> Any:
        """Return the message of one of the `paths`, or a BrokenImage where it is damaged.

        Raises:
            SlamError: the bag is damaged.
        """
        content = self._content(self._numbers[path])
        try:
            return self._bag.decoded(self._topic, content)
        except SlamError:
            return BrokenImage(path, "the message is damaged")

    def _read_times(self) -> tuple[list[int], list[int]]:
        """Return when each message was recorded and the time in its header, 0 without one, ns."""
        recorded_ns, stamps_ns = [], []
        for recorded, content in self._bag.raw(self._topic):
            recorded_ns.append(recorded)
            try:
                stamps_ns.append(time_ns(self._bag.decoded(self._topic, content)))
            except SlamError:
                stamps_ns.append(0)
        return recorded_ns, stamps_ns

    def _content(self, number: int) -> bytes:
        """Return what the message holds that was recorded as the n-th of its topic."""
        with self._lock:  # frames are read by more than one thread
            passed = dict(self._recent)
            if number in passed:
                return passed[number]
            last = max(passed, default=-1 - _NEAR)
            if not last < number <= last + _NEAR:
                self._look_for(number)
            for found, (_, content) in self._ahead:
                self._recent.append((found, content))
                if found == number:
                    return content
        raise SlamError("the bag no longer holds the message")

    def _look_for(self, number: int) -> None:
        start_ns = int(self._recorded_ns[number])
        numbers = np.flatnonzero(self._recorded_ns >= start_ns).tolist()
        self._recent.clear()
        self._ahead = zip(numbers, self._bag.raw(self._topic, start_ns), strict=False)

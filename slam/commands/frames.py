# SPDX-License-Identifier: Apache-2.0
"""The frames of a run, handed over one after the other, and who is told what became of them."""

import logging
import math
from collections.abc import Iterator, Sequence
from itertools import count
from threading import Event
from typing import Protocol

from placerec.commands.console import progress_bar
from slam.datasets import Sequence as Recording
from slam.external_odometry.pose_feed import PoseFeed
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Frame, Rejection

_log = logging.getLogger(__name__)


class Listener(Protocol):
    """Is told what a run does, as it does it."""

    def start_session(self) -> None:
        """Take the next frame for the first of another recording."""

    def add(self, frame: Frame, tracked: TrackedFrame | Rejection) -> None:
        """Take a frame, and what became of it."""


def process(
    slam: Slam,
    recordings: Sequence[Recording],
    feed: PoseFeed,
    listeners: Sequence[Listener],
    interrupted: Event,
) -> BaseException | None:
    """Feed all frames; return what stopped it early, so that the frames until then are kept."""
    try:
        for recording in recordings:
            slam.start_session()
            for listener in listeners:
                listener.start_session()
            for frame in _timed(slam, recording):
                feed.until(frame.timestamp_s)
                tracked = slam.process(frame)
                for listener in listeners:
                    listener.add(frame, tracked)
                if interrupted.is_set():  # half a keyframe could not be finished
                    return KeyboardInterrupt()
        feed.until(math.inf)
        slam.settle()  # if the recognizer failed on one of the last keyframes, say so
    except Exception as stopped:
        _log.debug("the run stopped early", exc_info=True)
        return stopped
    return None


def _timed(slam: Slam, recording: Recording) -> Iterator[Frame]:
    frames = iter(recording)
    with progress_bar("tracking", len(recording), "frame") as progress:
        for done in count(1):
            with slam.clock.stage("read"):
                frame = next(frames, None)
            if frame is None:
                return
            yield frame
            progress(done)

# SPDX-License-Identifier: Apache-2.0
"""What finds out where frames were taken: the odometry of the images, or the record of a run."""

from collections.abc import Iterable
from typing import Protocol

from slam.mapping.landmark_map import LandmarkMap
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import FloatArray, Frame, Rejection


class Tracker(Protocol):
    """Places one frame after the other, and knows of no loop."""

    @property
    def map(self) -> LandmarkMap | None:
        """All keyframes and landmarks so far; None where what keyframes show is not known."""

    def start_session(self) -> None:
        """Forget where the camera was: it may be anywhere when the next frame comes."""

    def track(
        self, frame: Frame, T_given_cam: FloatArray | None = None, is_keyframe: bool = False
    ) -> TrackedFrame | Rejection:
        """Place a frame, or say why it cannot be placed."""

    def settle(self) -> None:
        """Do what is still to be done about the last keyframe."""

    def T_odom_kf(self, keyframe_ids: Iterable[int]) -> dict[int, FloatArray]:
        """Return where keyframes are by now, (4, 4) by id, in the frames of their segments."""

# SPDX-License-Identifier: Apache-2.0
"""Where a camera was last, so that it can be followed, or found again."""

from dataclasses import dataclass, field

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray, IntArray, Keyframe

# Not placed for longer than this, the camera may be anywhere. Where no frame failed in between, as
# with a slow camera, it may also take so many times its last step, if that is longer.
_STILL_CLOSE_S, _STILL_CLOSE_STEPS = 0.25, 3.0
# A step is not thought to go on for longer than this many times its own duration: whoever stamps
# frames when they arrive has steps of a millisecond between long ones.
_LONGEST_STEP = 2.0


@dataclass(eq=False)
class MotionModel:
    """Where the camera was last in one segment, and how it moved there.

    Attributes:
        segment: whose it is.
        recent: the last keyframes.
        frames: how many were placed after the first one.
        was_lost: whether the segment began because the camera was lost.
        has_missed: whether the camera was looked for since its last frame, and not found.
        most_shared: landmarks that a frame had in common with the last keyframe.
        usual_inliers: landmarks that the last frame saw.
        last_s: time of the last frame.
        T_odom_last: (4, 4) where it was taken.
        last_ids: the landmarks it saw.
    """

    segment: int
    recent: list[Keyframe] = field(default_factory=list)
    frames: int = 0
    was_lost: bool = False
    has_missed: bool = False
    most_shared: int = 0
    usual_inliers: int = 0
    last_s: float = 0.0
    T_odom_last: FloatArray = field(default_factory=lambda: np.eye(4))
    last_ids: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    _step: FloatArray = field(default_factory=lambda: np.zeros(6))
    _step_s: float = 1.0

    @property
    def is_followed(self) -> bool:
        """Whether any frame was placed after the first one."""
        return self.frames > 0

    def follow(self, timestamp_s: float, T_odom_cam: FloatArray) -> float:
        """Take the (4, 4) place of the next frame and return how fast the camera turned, rad/s."""
        self._step = se3.log(se3.inverse(self.T_odom_last) @ T_odom_cam)
        self._step_s = timestamp_s - self.last_s
        self.last_s, self.T_odom_last = timestamp_s, T_odom_cam
        self.frames, self.has_missed = self.frames + 1, False
        return float(np.linalg.norm(self._step[:3])) / self._step_s

    def predict(self, timestamp_s: float) -> FloatArray:
        """Return where the camera is, (4, 4), if its last step goes on."""
        ahead = (timestamp_s - self.last_s) / self._step_s
        return self.T_odom_last @ se3.exp(self._step * min(ahead, _LONGEST_STEP))

    def velocity(self, timestamp_s: float, shortest_s: float) -> FloatArray:
        """Return the (6,) tangent per second of the last step; zeros if that was too long ago.

        No step really takes less than shortest_s, whatever its time stamps say.
        """
        is_over = timestamp_s - self.last_s > _STILL_CLOSE_S
        return np.zeros(6) if is_over else self._step / max(self._step_s, shortest_s)

    def velocity_to(
        self, timestamp_s: float, T_odom_cam: FloatArray, shortest_s: float
    ) -> FloatArray:
        """Return the same of the step to a (4, 4) place, which `follow` was not told yet."""
        step_s = timestamp_s - self.last_s
        if step_s > _STILL_CLOSE_S:
            return np.zeros(6)
        return se3.log(se3.inverse(self.T_odom_last) @ T_odom_cam) / max(step_s, shortest_s)

    def is_cold(self, timestamp_s: float) -> bool:
        """Return whether nothing was known of the camera for so long that it may be anywhere."""
        usual_s = 0.0 if self.has_missed else _STILL_CLOSE_STEPS * self._step_s
        return timestamp_s - self.last_s > max(_STILL_CLOSE_S, usual_s)

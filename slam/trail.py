# SPDX-License-Identifier: Apache-2.0
"""Where a camera was last, so that it can be followed, or found again."""

from dataclasses import dataclass, field

import numpy as np

from slam.landmarks import IntArray
from slam.types import FloatArray, Keyframe


@dataclass(eq=False)
class Trail:
    """Where the camera was last in one segment, and how it moved there.

    Attributes:
        segment: whose it is.
        recent: the last keyframes.
        is_followed: whether any frame was placed after the first one.
        most_shared: landmarks that a frame had in common with the last keyframe.
        last_s: time of the last frame.
        T_odom_last: (4, 4) where it was taken.
        velocity: (6,) tangent per second, in the camera's frame: the motion that should go on.
        last_ids: the landmarks it saw.
    """

    segment: int
    recent: list[Keyframe] = field(default_factory=list)
    is_followed: bool = False
    most_shared: int = 0
    last_s: float = 0.0
    T_odom_last: FloatArray = field(default_factory=lambda: np.eye(4))
    velocity: FloatArray = field(default_factory=lambda: np.zeros(6))
    last_ids: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

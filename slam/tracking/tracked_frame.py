# SPDX-License-Identifier: Apache-2.0
"""What tracking says of a frame, and the keyframe that a frame becomes."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from slam.types import Features, FloatArray, Frame, Keyframe, Link


@dataclass(frozen=True)
class TrackedFrame:
    """A frame that was placed.

    Attributes:
        keyframe_id: the keyframe it was placed against, itself where it became one.
        T_kf_cam: (4, 4) pose in that keyframe's camera frame.
        T_odom_cam: (4, 4) pose in the odometry's frame of its segment, as of now.
        segment: a number per stretch in which the camera was not lost and no session ended.
        new_keyframe: the frame as a keyframe, where it became one.
        links: the new keyframe's motions to earlier ones.
        moved: (4, 4) T_odom_cam by id of the keyframes that the odometry moved since the last new
            one; empty where the frame is no keyframe.
        covered: in which share of the image features agree on the pose.
    """

    keyframe_id: int
    T_kf_cam: FloatArray
    T_odom_cam: FloatArray
    segment: int = 0
    new_keyframe: Keyframe | None = None
    links: tuple[Link, ...] = ()
    moved: Mapping[int, FloatArray] = field(default_factory=dict)
    covered: float = 1.0


def new_keyframe(
    keyframe_id: int,
    preview: Frame,
    features: Features,
    T_odom_cam: FloatArray,
    turning_rad_s: float,
    segment: int,
) -> Keyframe:
    """Return the keyframe that a frame at a (4, 4) pose becomes, of which this is left."""
    return Keyframe(
        id=keyframe_id,
        timestamp_s=preview.timestamp_s,
        T_odom_cam=T_odom_cam,
        features=features,
        preview=preview,
        turning_rad_s=turning_rad_s,
        segment=segment,
    )


def preview(frame: Frame) -> Frame:
    """Return the frame at half resolution: colour averaged, depth picked (never mixed).

    Pixel (u, v) of the preview's depth is pixel (2 u, 2 v) of the frame's.
    """
    height, width = (size // 2 * 2 for size in frame.depth_m.shape)
    rgb = frame.rgb[:height, :width]
    rows = np.add(rgb[::2], rgb[1::2], dtype=np.uint16)
    summed = rows[:, ::2] + rows[:, 1::2]
    return Frame(
        timestamp_s=frame.timestamp_s,
        rgb=(summed // 4).astype(np.uint8),
        depth_m=np.array(frame.depth_m[:height:2, :width:2], np.float32),
    )

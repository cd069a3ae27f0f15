# SPDX-License-Identifier: Apache-2.0
"""The half-resolution copy of a frame that a keyframe keeps for pictures and the point cloud."""

import numpy as np

from slam.types import Frame

PREVIEW_SCALE = 0.5


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
        depth_m=frame.depth_m[:height:2, :width:2].copy(),
    )

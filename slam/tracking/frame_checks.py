# SPDX-License-Identifier: Apache-2.0
"""Whether a frame can be taken at all, before anybody looks at what it shows."""

import numpy as np

from slam.types import Camera, Frame, SlamError


def check_frame(frame: Frame, camera: Camera, last_s: float) -> None:
    """Refuse a frame that cannot follow on one taken at last_s by this camera.

    Raises:
        SlamError: the frame is not of the camera's size, or the time does not increase.
    """
    if not last_s < frame.timestamp_s < np.inf:
        raise SlamError(
            f"frames must come in the order of time: {frame.timestamp_s:.6f} s after {last_s:.6f} s"
        )
    wanted = (camera.height, camera.width)
    if frame.rgb.dtype != np.uint8:
        raise SlamError(
            f"the frame at {frame.timestamp_s:.6f} s has {frame.rgb.dtype} colours, not uint8"
        )
    if frame.rgb.shape != (*wanted, 3) or frame.depth_m.shape != wanted:
        raise SlamError(
            f"the frame at {frame.timestamp_s:.6f} s has colour {frame.rgb.shape} and depth"
            f" {frame.depth_m.shape}, but the camera makes {(*wanted, 3)} and {wanted}"
        )

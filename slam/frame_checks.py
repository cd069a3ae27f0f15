# SPDX-License-Identifier: Apache-2.0
"""What callers hand over is looked at before it gets in: images, times and poses."""

import numpy as np

from slam.types import Camera, FloatArray, Frame, SlamError


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


def checked_pose(timestamp_s: float, T_odom_cam: FloatArray) -> FloatArray:
    """Return a copy of a pose, since callers reuse their matrix.

    Raises:
        SlamError: it is not a rigid (4, 4) transform.
    """
    T = np.array(T_odom_cam, dtype=np.float64)
    is_affine = T.shape == (4, 4) and np.isfinite(T).all() and np.allclose(T[3], [0, 0, 0, 1])
    R = T[:3, :3] if is_affine else np.zeros((3, 3))
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0):
        raise SlamError(
            f"the pose at {timestamp_s:.6f} s is not a rigid (4, 4) transform T_odom_cam"
        )
    return T

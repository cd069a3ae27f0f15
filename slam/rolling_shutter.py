# SPDX-License-Identifier: Apache-2.0
"""Features as they would have been seen had all rows of the image been taken at once."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from slam.types import Camera, Features, FloatArray


def straightened(features: Features, camera: Camera, velocity: FloatArray) -> Features:
    """Return the features where the camera saw them from its place at the middle row.

    A row that is read out later was seen from where the camera had moved on to. What has no depth
    is turned alone.

    Args:
        features: of one image.
        camera: its readout_s is how long the rows took.
        velocity: (6,) tangent per second of the camera in its own frame, rotation first.
    """
    time_s = camera.readout_s * ((features.pixels[:, 1] + 0.5) / camera.height - 0.5)
    has_depth = np.isfinite(features.depth_m)
    rays = (features.undistorted_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points_m = np.column_stack([rays, np.ones(len(rays))])
    points_m *= np.where(has_depth, features.depth_m, 1.0)[:, None]
    points_m = Rotation.from_rotvec(time_s[:, None] * velocity[:3]).apply(points_m)
    points_m += (has_depth * time_s)[:, None] * velocity[3:]
    pixels = points_m[:, :2] / points_m[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    unknown = np.where(has_depth, 1.0, np.nan)[:, None]
    return replace(
        features,
        undistorted_px=pixels,
        depth_m=points_m[:, 2] * unknown[:, 0],
        points_m=points_m * unknown,
    )

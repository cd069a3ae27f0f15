# SPDX-License-Identifier: Apache-2.0
"""What the poses of an odometry from elsewhere mean, and the camera's poses that follow."""

from dataclasses import dataclass, field

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray, Trajectory


@dataclass(frozen=True)
class Convention:
    """How poses have to be read to be those of the camera.

    Attributes:
        T_base_cam: (4, 4), where the camera is on the body that the poses are of.
        scale: metres per unit of their translations.
        time_offset_s: how much later their time stamps are than those of the images.
        is_inverted: whether they take the world to the body.
        is_w_first: whether a quaternion w x y z was read as x y z w.
    """

    T_base_cam: FloatArray = field(default_factory=lambda: np.eye(4))
    scale: float = 1.0
    time_offset_s: float = 0.0
    is_inverted: bool = False
    is_w_first: bool = False

    def body_poses(self, given: Trajectory) -> Trajectory:
        """Return the body's poses, metres, at the images' times."""
        T = given.T_world_cam.copy()
        if self.is_w_first:
            as_read = se3.to_quaternion(T[:, :3, :3])
            T[:, :3, :3] = se3.from_quaternion(np.roll(as_read, -1, axis=-1))
        T[:, :3, 3] *= self.scale
        if self.is_inverted:
            T = se3.inverse(T)
        return Trajectory(given.timestamps_s - self.time_offset_s, T)

    def camera_poses(self, given: Trajectory) -> Trajectory:
        """Return the camera's poses, metres, at the images' times."""
        body = self.body_poses(given)
        return Trajectory(body.timestamps_s, body.T_world_cam @ self.T_base_cam)

    def as_given(self, camera: Trajectory) -> Trajectory:
        """Return poses as they would have been given, of the camera's; `camera_poses` undone."""
        T = camera.T_world_cam @ se3.inverse(self.T_base_cam)
        if self.is_inverted:
            T = se3.inverse(T)
        T[:, :3, 3] /= self.scale
        if self.is_w_first:
            right = se3.to_quaternion(T[:, :3, :3])
            T[:, :3, :3] = se3.from_quaternion(np.roll(right, 1, axis=-1))
        return Trajectory(camera.timestamps_s + self.time_offset_s, T)

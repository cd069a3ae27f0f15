# SPDX-License-Identifier: Apache-2.0
"""Keyframes whose poses come from another odometry."""

import numpy as np

from slam.config import Config
from slam.geometry import se3
from slam.geometry.features import FeatureExtractor
from slam.tracking.tracked_frame import TrackedFrame, new_keyframe
from slam.types import Camera, FloatArray, Frame, Keyframe, Link, RelativePose


class GivenPoses:
    """Makes a keyframe of every frame, linked to the one before by the step between their poses."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self._extractor = FeatureExtractor(camera, config.features)
        rotation_rad = np.radians(config.graph.outside_rotation_sigma_deg)
        translation_m = config.graph.outside_translation_sigma_m
        self._information = np.diag([rotation_rad**-2.0] * 3 + [translation_m**-2.0] * 3)
        self._last: Keyframe | None = None  # of this session
        self._count = 0
        self._segment = 0

    def start_session(self) -> None:
        """Take the next frame for the first of another recording."""
        self._segment += self._last is not None
        self._last = None

    def track(self, frame: Frame, T_odom_cam: FloatArray) -> TrackedFrame:
        """Return the frame as a keyframe at its (4, 4) pose."""
        links: tuple[Link, ...] = ()
        turning_rad_s = 0.0
        if self._last:
            step = RelativePose(se3.inverse(self._last.T_odom_cam) @ T_odom_cam, self._information)
            links = (Link(self._last.id, self._count, step),)
            turned_rad = float(se3.rotation_angle(step.T_ref_query))
            turning_rad_s = turned_rad / (frame.timestamp_s - self._last.timestamp_s)
        features = self._extractor.extract(frame)
        self._last = new_keyframe(
            self._count, frame, features, T_odom_cam, turning_rad_s, self._segment
        )
        self._count += 1
        return TrackedFrame(self._last.id, np.eye(4), T_odom_cam, self._segment, self._last, links)

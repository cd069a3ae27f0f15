# SPDX-License-Identifier: Apache-2.0
"""RGB-D odometry: every frame is placed against the last keyframe."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam import se3
from slam.config import Config, VerificationConfig
from slam.features import FeatureExtractor
from slam.preview import preview
from slam.relative_pose import allow_for_turning, estimate_relative_pose
from slam.types import (
    Camera,
    Features,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    Rejection,
    RejectionReason,
    RelativePose,
    Verification,
)


@dataclass(frozen=True)
class TrackedFrame:
    """A frame that was placed.

    Attributes:
        keyframe_id: the keyframe it was placed against.
        T_kf_cam: (4, 4) pose in that keyframe's camera frame.
        new_keyframe: the frame as a keyframe, where it became one.
        links: the new keyframe's motions to earlier ones, the one it was placed against first.
    """

    keyframe_id: int
    T_kf_cam: FloatArray
    new_keyframe: Keyframe | None = None
    links: tuple[Link, ...] = ()


class RgbdOdometry:
    """Tracks a camera frame by frame and decides which frames become keyframes."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self._camera = camera
        self._config = config.odometry
        self._link_config = config.verification
        # A frame that follows its keyframe needs less evidence than a jump across the map.
        self._tracking_config = config.verification.model_copy(
            update={
                "min_matches": config.odometry.min_inliers,
                "min_inliers": config.odometry.min_inliers,
                "min_inlier_ratio": 0.0,
                "min_support": 0.0,
            }
        )
        self._extractor = FeatureExtractor(camera, config.features)
        self._recent: list[Keyframe] = []
        self._full_inliers = 0  # the most seen against the last keyframe
        self._last_s, self._T_odom_last = 0.0, np.eye(4)

    def track(self, frame: Frame) -> TrackedFrame | Rejection:
        """Place a frame, or say why it cannot be placed; later frames are tried all the same."""
        features = self._extractor.extract(frame)
        if not self._recent:
            return self._start(frame, features)
        rejection: Rejection | None = None
        for keyframe in reversed(self._recent):
            found = self._estimate(keyframe, features, self._tracking_config)
            if isinstance(found.outcome, RelativePose):
                return self._place(frame, features, keyframe, found.outcome, found.inlier_mask)
            rejection = rejection or found.outcome
        assert rejection is not None
        return rejection

    def _start(self, frame: Frame, features: Features) -> TrackedFrame | Rejection:
        with_depth, needed = int(np.count_nonzero(features.depth_m > 0.0)), self._config.min_inliers
        if with_depth < needed:
            return Rejection(RejectionReason.FEW_MATCHES, with_depth, needed)
        keyframe = Keyframe(0, frame.timestamp_s, np.eye(4), features, preview(frame))
        self._remember(keyframe)
        return TrackedFrame(keyframe.id, np.eye(4), keyframe)

    def _place(
        self,
        frame: Frame,
        features: Features,
        reference: Keyframe,
        motion: RelativePose,
        inlier_mask: NDArray[np.bool_],
    ) -> TrackedFrame:
        T_odom_cam = reference.T_odom_cam @ motion.T_ref_query
        turned_rad = float(se3.rotation_angle(se3.inverse(self._T_odom_last) @ T_odom_cam))
        turning_rad_s = turned_rad / (frame.timestamp_s - self._last_s)
        self._last_s, self._T_odom_last = frame.timestamp_s, T_odom_cam
        inliers = int(np.count_nonzero(inlier_mask))
        self._full_inliers = max(self._full_inliers, inliers)
        if not self._needs_keyframe(motion.T_ref_query, inliers):
            return TrackedFrame(reference.id, motion.T_ref_query)
        new_id = self._recent[-1].id + 1
        links = self._links(reference, motion, features, new_id, turning_rad_s)
        keyframe = Keyframe(
            new_id, frame.timestamp_s, self._fuse(links), features, preview(frame), turning_rad_s
        )
        self._remember(keyframe)
        return TrackedFrame(reference.id, motion.T_ref_query, keyframe, links)

    def _needs_keyframe(self, T_ref_cam: FloatArray, inliers: int) -> bool:
        return bool(
            se3.translation_norm(T_ref_cam) > self._config.keyframe_translation_m
            or np.degrees(se3.rotation_angle(T_ref_cam)) > self._config.keyframe_rotation_deg
            or inliers < self._config.keyframe_inlier_share * self._full_inliers
        )

    def _links(
        self,
        reference: Keyframe,
        motion: RelativePose,
        features: Features,
        new_id: int,
        turning_rad_s: float,
    ) -> tuple[Link, ...]:
        """Tie a new keyframe to its reference and to the other recent ones that see the same."""
        motions = {reference.id: (reference, motion)}
        for earlier in reversed(self._recent):
            if earlier.id != reference.id:
                outcome = self._estimate(earlier, features, self._link_config).outcome
                if isinstance(outcome, RelativePose):
                    motions[earlier.id] = earlier, outcome
        return tuple(
            Link(earlier.id, new_id, allow_for_turning(seen, earlier.turning_rad_s, turning_rad_s))
            for earlier, seen in motions.values()
        )

    def _fuse(self, links: tuple[Link, ...]) -> FloatArray:
        """Return the new keyframe's T_odom_cam: the mean of what its links say, by information."""
        T_odom_kf = {keyframe.id: keyframe.T_odom_cam for keyframe in self._recent}
        T_odom_cam = T_odom_kf[links[0].ref_id] @ links[0].motion.T_ref_query
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        for link in links:
            T_odom_said = T_odom_kf[link.ref_id] @ link.motion.T_ref_query
            hessian += link.motion.information
            gradient += link.motion.information @ se3.log(se3.inverse(T_odom_cam) @ T_odom_said)
        step = np.asarray(np.linalg.solve(hessian, gradient), dtype=np.float64)
        return T_odom_cam @ se3.exp(step)

    def _estimate(
        self, reference: Keyframe, features: Features, config: VerificationConfig
    ) -> Verification:
        return estimate_relative_pose(reference.features, features, self._camera, config)

    def _remember(self, keyframe: Keyframe) -> None:
        self._recent = [*self._recent, keyframe][-1 - self._config.links :]
        self._full_inliers = 0
        self._last_s, self._T_odom_last = keyframe.timestamp_s, keyframe.T_odom_cam

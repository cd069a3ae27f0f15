# SPDX-License-Identifier: Apache-2.0
"""RGB-D odometry: every frame is placed among the landmarks of a local map."""

from dataclasses import dataclass

import numpy as np

from slam.config import Config, VerificationConfig
from slam.geometry import se3
from slam.geometry.feature_grid import FeatureGrid
from slam.geometry.features import FeatureExtractor, straightened
from slam.geometry.relative_pose import (
    allow_for_turning,
    estimate_relative_pose,
    measure_relative_pose,
    with_floor,
)
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.mapping.landmarks import UNSEEN
from slam.mapping.local_map import LocalMap
from slam.tracking.frame_pose import Placement, View, agreed_pose, look_around
from slam.tracking.motion_model import Trail
from slam.types import (
    Camera,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    Rejection,
    RejectionReason,
    RelativePose,
    preview,
)

# How far from its place a landmark is looked for, in pixels of the finest level.
_PREDICTED_RADII_PX = (15.0, 40.0)  # where the last motion should have gone on; then wider
# So many of the features wanted have to have depth. Frames of fr1_desk show 67 % and more, blurred
# by 31 pixels 21 %; blurred by 121 pixels it is less than 10 %, and nothing could be matched to it.
_WORTH_A_SEGMENT = 0.1
_TRAILS = 2  # a lost camera is looked for on the last one and on the one before


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
        # A jump needs as much as a loop, where a frame that follows does not need more.
        fewest = max(config.odometry.min_inliers, config.verification.min_inliers)
        self._jump_config = config.verification.model_copy(update={"min_inliers": fewest})
        self._extractor = FeatureExtractor(camera, config.features)
        self._local_map = LocalMap(camera, config)
        self._worth_a_segment = _WORTH_A_SEGMENT * config.features.count
        self._segments = 0
        self._near = 0  # the segment whose landmarks the local map has gathered
        self._trails: list[Trail] = []  # the last is the one that is followed

    @property
    def map(self) -> LandmarkMap:
        """All keyframes and landmarks so far, each segment in an odometry's frame of its own."""
        return self._local_map.whole

    def start_session(self) -> None:
        """Forget where the camera was: it may be anywhere when the next frame comes."""
        self.settle()
        self._trails = []

    def track(self, frame: Frame) -> TrackedFrame | Rejection:
        """Place a frame, or say why it cannot be placed; later frames are tried all the same.

        A frame that shows enough, but nothing of what was seen last, begins a new segment.
        """
        features = self._extractor.extract(frame)
        self.settle()
        if self._trails and (readout_s := self._camera.readout_s) > 0.0:
            velocity = self._trails[-1].velocity(frame.timestamp_s, shortest_s=readout_s)
            features = straightened(features, self._camera, velocity)
        view = View(frame, features, FeatureGrid(features, self._camera))
        if not self._trails:
            return self._start(view)
        placement = self._find(view)
        if isinstance(placement, Placement):
            return self._go_on(view, placement)
        for trail in self._trails:
            trail.has_missed = True
        return self._start(view) if view.with_depth >= self._worth_a_segment else placement

    def settle(self) -> None:
        """Adjust the map to the last keyframe, and go on from where that puts it."""
        if self._local_map.settle():
            trail = self._trails[-1]
            last_id = trail.recent[-1].id
            trail.T_odom_last = self.map.keyframes[last_id].T_map_cam
            trail.last_ids = self.map.seen_by([last_id])

    def _start(self, view: View) -> TrackedFrame | Rejection:
        """Begin a segment whose origin is the view."""
        if view.with_depth < (needed := self._tracking_config.min_matches):
            return Rejection(RejectionReason.FEW_MATCHES, view.with_depth, needed)
        # A segment that no second frame followed is nothing to come back to.
        worthwhile = [trail for trail in self._trails if trail.is_followed]
        trail = Trail(self._segments, last_s=view.frame.timestamp_s)
        self._trails = [*worthwhile[1 - _TRAILS :], trail]
        self._segments += 1
        here = Placement(np.eye(4), empty_pairs(), np.zeros((6, 6)))
        keyframe = self._insert(view, here, turning_rad_s=0.0)
        return TrackedFrame(keyframe.id, np.eye(4), keyframe)

    def _find(self, view: View) -> Placement | Rejection:
        if not self._trails[-1].is_cold(view.frame.timestamp_s):
            placement = self._follow(view)
            if isinstance(placement, Placement):
                return placement
        return self._recover(view)

    def _follow(self, view: View) -> Placement | Rejection:
        """Look for what the last frame saw where it should be by now, then for all around it."""
        trail, config = self._trails[-1], self._tracking_config
        T_predicted = trail.predict(view.frame.timestamp_s)
        last_ids = self.map.landmarks.resolve(trail.last_ids)
        last_ids = np.unique(last_ids[last_ids != UNSEEN])
        for radius_px in _PREDICTED_RADII_PX:
            pairs = self.map.search(view.grid, T_predicted, last_ids, radius_px)
            agreed = agreed_pose(self.map, view, pairs, config)
            if not isinstance(agreed, Rejection):
                return look_around(self.map, view, agreed, self._local_map.nearby_ids, config)
            rejection = agreed
        return rejection

    def _recover(self, view: View) -> Placement | Rejection:
        """Compare the view with all features of the last keyframes, wherever it may be."""
        is_jump = False
        for trail in reversed(self._trails):
            is_jump = is_jump or trail.is_cold(view.frame.timestamp_s)
            config = self._jump_config if is_jump else self._tracking_config
            placement = self._recover_on(trail, view, config)
            if isinstance(placement, Placement):
                self._trails.remove(trail)
                self._trails.append(trail)
                return placement
            is_jump = is_jump or trail.is_followed  # what was before it is across the map
        return placement

    def _recover_on(
        self, trail: Trail, view: View, config: VerificationConfig
    ) -> Placement | Rejection:
        rejections = []
        for keyframe in reversed(trail.recent):
            outcome = estimate_relative_pose(
                keyframe.features, view.features, self._camera, config
            ).outcome
            if isinstance(outcome, Rejection):
                rejections.append(outcome)
                continue
            T_odom_cam = self.map.keyframes[keyframe.id].T_map_cam @ outcome.T_ref_query
            seen_ids = self.map.seen_by([keyframe.id])
            placement = look_around(self.map, view, T_odom_cam, seen_ids, config)
            if isinstance(placement, Placement):
                return placement
            rejections.append(placement)
        return rejections[0]

    def _go_on(self, view: View, placement: Placement) -> TrackedFrame:
        """Remember where the camera is and how it moves; make the view a keyframe if need be."""
        trail = self._trails[-1]
        reference = trail.recent[-1]
        turning_rad_s = trail.follow(view.frame.timestamp_s, placement.T_map_cam)
        trail.last_ids = placement.pairs[:, 0]
        T_kf_cam = se3.inverse(self.map.keyframes[reference.id].T_map_cam) @ placement.T_map_cam
        if not self._needs_keyframe(placement, T_kf_cam):
            return TrackedFrame(reference.id, T_kf_cam)
        keyframe = self._insert(view, placement, turning_rad_s)
        links = self._links(keyframe, reference, with_floor(T_kf_cam, placement.hessian))
        return TrackedFrame(reference.id, T_kf_cam, keyframe, links)

    def _needs_keyframe(self, placement: Placement, T_ref_cam: FloatArray) -> bool:
        trail = self._trails[-1]
        seen_by_reference = self.map.seen_by([trail.recent[-1].id])
        shared = int(np.count_nonzero(np.isin(placement.pairs[:, 0], seen_by_reference)))
        trail.most_shared = max(trail.most_shared, shared)
        return bool(
            se3.translation_norm(T_ref_cam) > self._config.keyframe_translation_m
            or np.degrees(se3.rotation_angle(T_ref_cam)) > self._config.keyframe_rotation_deg
            or shared < self._config.keyframe_inlier_share * trail.most_shared
            or trail.segment != self._near  # what is nearby has to be gathered again
        )

    def _insert(self, view: View, placement: Placement, turning_rad_s: float) -> Keyframe:
        """Make a keyframe of the view, which stays where it was placed until the next frame."""
        new_id = self._local_map.insert(
            view.features, view.grid, placement.T_map_cam, placement.pairs
        )
        trail = self._trails[-1]
        trail.most_shared, self._near = 0, trail.segment
        keyframe = Keyframe(
            id=new_id,
            timestamp_s=view.frame.timestamp_s,
            T_odom_cam=placement.T_map_cam,
            features=view.features,
            preview=preview(view.frame),
            turning_rad_s=turning_rad_s,
            segment=trail.segment,
        )
        trail.recent = [*trail.recent, keyframe][-1 - self._config.links :]
        return keyframe

    def _links(self, new: Keyframe, reference: Keyframe, motion: RelativePose) -> tuple[Link, ...]:
        """Tie a new keyframe to its reference and to the other recent ones that see the same."""
        motions = [(reference, motion)]
        for earlier in reversed(self._trails[-1].recent[:-1]):
            if earlier.id != reference.id:
                pairs = self.map.shared_features(earlier.id, new.id)
                measured = measure_relative_pose(
                    earlier.features, new.features, pairs, self._camera, self._link_config
                )
                if isinstance(measured.outcome, RelativePose):
                    motions.append((earlier, measured.outcome))
        return tuple(
            Link(each.id, new.id, allow_for_turning(seen, each.turning_rad_s, new.turning_rad_s))
            for each, seen in motions
        )

# SPDX-License-Identifier: Apache-2.0
"""RGB-D odometry: every frame is placed among the landmarks of a local map."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from slam.config import Config
from slam.geometry import se3
from slam.geometry.features import FeatureExtractor, grey_of, straightened
from slam.geometry.keyframe_memory import KeyframeMemory
from slam.geometry.smear import SmearFinder
from slam.mapping.keyframe_links import covisible_links
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.mapping.landmarks import is_among
from slam.mapping.local_map import LocalMap
from slam.tracking.frame_pose import (
    FramePose,
    View,
    agreed_pose,
    pose_by_keyframes,
    refined_pose,
    track_local_map,
)
from slam.tracking.motion_model import MotionModel
from slam.tracking.tracked_frame import TrackedFrame, new_keyframe, preview
from slam.tracking.trails import Recognize, Trails
from slam.types import (
    Camera,
    Features,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    Rejection,
    RejectionReason,
)

_log = logging.getLogger(__name__)
# How far from its place a landmark is looked for, in pixels of the finest level.
_PREDICTED_RADII_PX = (15.0, 40.0)  # where the last motion should have gone on; then wider
_AS_USUAL = 0.5  # share of the landmarks that the frame before saw
# So many of the features wanted have to have depth. Frames of fr1_desk show 67 % and more, blurred
# by 31 pixels 21 %; blurred by 121 pixels it is less than 10 %, and nothing could be matched to it.
_WORTH_A_SEGMENT = 0.1


class RgbdOdometry:
    """Tracks a camera frame by frame and decides which frames become keyframes."""

    def __init__(
        self,
        camera: Camera,
        config: Config,
        recognize: Recognize = lambda *_: (),
        scratch: Path | None = None,
    ) -> None:
        self._camera = camera
        self._config = config.odometry
        self._extractor = FeatureExtractor(camera, config.features)
        self._local_map = LocalMap(camera, config)
        self._trails = Trails(self._local_map.whole, config, recognize)
        self._smears = SmearFinder()
        most_bytes = config.keyframes.memory_mb * 1_000_000
        self._memory = KeyframeMemory(most_bytes, camera.depth_scale, scratch)
        self._worth_a_segment = _WORTH_A_SEGMENT * config.features.count
        self._moved: set[int] = set()  # keyframes that were adjusted since the last new one
        self._segments = 0
        self._T_given_last: FloatArray | None = None  # where another odometry had the last frame
        self._near: MotionModel | None = None  # around which the local map has gathered landmarks
        self._has_earlier, self._is_fixed = False, False

    def load(self, keyframes: Sequence[Keyframe], the_map: LandmarkMap, is_fixed: bool) -> None:
        """Begin with an earlier map, one segment, which is taken over; a fixed one stays as it is.

        Frames of the first view on are looked for in it; a fixed map gets no keyframes, and frames
        that show nothing of it are not placed.
        """
        self._local_map.load(the_map)
        self._trails.load(keyframes)
        self._segments, self._has_earlier, self._is_fixed = 1, True, is_fixed

    @property
    def map(self) -> LandmarkMap:
        """All keyframes and landmarks so far, each segment in an odometry's frame of its own."""
        return self._local_map.whole

    def T_odom_kf(self, keyframe_ids: Iterable[int]) -> dict[int, FloatArray]:
        """Return where keyframes are by now, (4, 4) by id, each in its segment's odometry frame."""
        return {k: self.map.keyframes[k].T_map_cam for k in keyframe_ids}

    def start_session(self) -> None:
        """Forget where the camera was: it may be anywhere when the next frame comes."""
        self.settle()
        self._trails.forget()
        self._T_given_last = None

    def track(
        self,
        frame: Frame,
        T_given_cam: FloatArray | None = None,
        is_keyframe: bool = False,
    ) -> TrackedFrame | Rejection:
        """Place a frame, or say why it cannot be placed; later frames are tried all the same.

        A frame that shows enough, but nothing of what was seen last or recognized, begins a new
        segment. Where an odometry from elsewhere has the camera, a (4, 4) pose in a frame of its
        own, helps to find it again where its motion did not go on. A frame that has to be a
        keyframe becomes one if it can be placed.

        Raises:
            RecognizerError: whoever was asked to recognize the frame failed.
        """
        grey = grey_of(frame.rgb)
        seen = self._extractor.extract(grey, frame.depth_m)
        self._move(self._local_map.next_frame())
        if not self._trails:
            return self._begin(View(frame, seen, self._camera), T_given_cam, is_keyframe)
        velocity = self._trails.followed.velocity(
            frame.timestamp_s, shortest_s=self._camera.readout_s
        )
        view = View(frame, straightened(seen, self._camera, velocity), self._camera)
        if rejection := self._smears.find(grey):
            self._trails.miss()
            return rejection
        frame_pose: FramePose | Rejection | None = None
        if expected := self._expected(frame.timestamp_s, T_given_cam):
            frame_pose = self._follow(view, expected)
        if not isinstance(frame_pose, FramePose):
            frame_pose = self._trails.relocalize(view)
        is_worth_more = view.with_depth >= self._worth_a_segment
        if not isinstance(frame_pose, FramePose):
            if is_worth_more:
                frame_pose = self._trails.recognize(view) or frame_pose
        else:
            frame_pose = self._trails.recognize_elsewhere(view) or frame_pose
        if isinstance(frame_pose, FramePose):
            view, frame_pose = self._straightened_again(view, seen, frame_pose)
            self._T_given_last = T_given_cam
            return self._go_on(view, frame_pose, is_keyframe)
        self._trails.miss()
        if self._is_fixed:
            return frame_pose
        return self._start(view, T_given_cam) if is_worth_more else frame_pose

    def _begin(
        self, view: View, T_given_cam: FloatArray | None, is_keyframe: bool
    ) -> TrackedFrame | Rejection:
        """Place the first view of a session: in an earlier map that shows it, else at an origin."""
        if self._has_earlier and view.with_depth >= self._worth_a_segment:
            frame_pose = self._trails.recognize(view)
            if isinstance(frame_pose, FramePose):
                self._T_given_last = T_given_cam
                return self._go_on(view, frame_pose, is_keyframe)
        if self._is_fixed:
            needed = self._trails.following_config.min_matches
            return Rejection(RejectionReason.FEW_MATCHES, 0, needed)
        return self._start(view, T_given_cam)

    def _straightened_again(
        self, view: View, seen: Features, frame_pose: FramePose
    ) -> tuple[View, FramePose]:
        """Return view and pose by the features as seen, straightened by how the camera moves now.

        Until its pose was known, all that was known is how the camera moved before.
        """
        T_map_cam, readout_s = frame_pose.T_map_cam, self._camera.readout_s
        if readout_s == 0.0:
            return view, frame_pose
        velocity = self._trails.followed.velocity_to(view.frame.timestamp_s, T_map_cam, readout_s)
        again = replace(view, features=straightened(seen, self._camera, velocity))
        config = self._trails.following_config
        refined = refined_pose(self.map, again, T_map_cam, frame_pose.pairs, config)
        return (again, refined) if isinstance(refined, FramePose) else (view, frame_pose)

    def settle(self) -> None:
        """Adjust the map to the last keyframe, and go on from where that puts it."""
        self._move(self._local_map.settle())

    def _move(self, T_new_old: Mapping[int, FloatArray]) -> None:
        self._moved.update(T_new_old)
        self._trails.move(T_new_old)

    def _start(self, view: View, T_given_cam: FloatArray | None) -> TrackedFrame | Rejection:
        """Begin a segment whose origin is the view."""
        if view.with_depth < (needed := self._trails.following_config.min_matches):
            return Rejection(RejectionReason.FEW_MATCHES, view.with_depth, needed)
        self.settle()
        was_lost = bool(self._trails) or self._has_earlier  # where it is, the map may tell later
        last_s = view.frame.timestamp_s
        _log.info("segment %d begins at %.6f s", self._segments, last_s)
        self._trails.begin(MotionModel(self._segments, was_lost=was_lost, last_s=last_s))
        self._segments += 1
        self._T_given_last = T_given_cam
        here = FramePose(np.eye(4), empty_pairs(), np.zeros((6, 6)))
        keyframe = self._insert(view, here, turning_rad_s=0.0)
        return self._placed(keyframe, np.eye(4), keyframe)

    def _expected(self, timestamp_s: float, T_given_cam: FloatArray | None) -> list[FloatArray]:
        """Return where the camera may be by now: by its last motion, and by another odometry."""
        model = self._trails.followed
        expected = [] if model.is_cold(timestamp_s) else [model.predict(timestamp_s)]
        if T_given_cam is not None and self._T_given_last is not None:
            expected.append(model.T_odom_last @ se3.inverse(self._T_given_last) @ T_given_cam)
        return expected

    def _follow(self, view: View, expected: Sequence[FloatArray]) -> FramePose | Rejection:
        """Look for what the last frame saw where it should be by now, then for all around it."""
        model, config = self._trails.followed, self._trails.following_config
        last_ids = self.map.landmarks.distinct(model.last_ids)
        best: FramePose | None = None
        for radius_px, T_predicted in product(_PREDICTED_RADII_PX, expected):
            pairs = self.map.search(view.grid, T_predicted, last_ids, radius_px)
            agreed = agreed_pose(self.map, view, pairs, config)
            if isinstance(agreed, Rejection):
                rejection: Rejection = agreed
                continue
            found = track_local_map(self.map, view, agreed, self._local_map.nearby_ids, config)
            if isinstance(found, Rejection):
                rejection = found
            elif best is None or len(found.pairs) > len(best.pairs):
                best = found
            # Where the camera turns away from where its motion should have gone on, some landmarks
            # at its edge agree on something else.
            if best and len(best.pairs) >= _AS_USUAL * model.usual_inliers:
                return best
        if best is None:
            return rejection
        found = pose_by_keyframes(self.map, view, model.recent[-1:], config)
        is_better = isinstance(found, FramePose) and len(found.pairs) > len(best.pairs)
        return found if is_better else best

    def _go_on(self, view: View, frame_pose: FramePose, is_keyframe: bool) -> TrackedFrame:
        """Remember where the camera is and how it moves; make the view a keyframe if need be."""
        covered = view.covered(frame_pose.pairs[:, 1])
        model = self._trails.followed
        reference = model.recent[-1]
        turning_rad_s = model.follow(view.frame.timestamp_s, frame_pose.T_map_cam)
        model.last_ids = frame_pose.pairs[:, 0]
        model.usual_inliers = len(frame_pose.pairs)
        T_kf_cam = se3.inverse(self.map.keyframes[reference.id].T_map_cam) @ frame_pose.T_map_cam
        if not self._needs_keyframe(frame_pose, T_kf_cam) and not is_keyframe:
            return replace(self._placed(reference, T_kf_cam), covered=covered)
        if self._is_fixed:
            return replace(self._placed_elsewhere(frame_pose), covered=covered)
        if moved := self._local_map.settle():
            self._move(moved)
            frame_pose = self._placed_again(view, frame_pose)
        keyframe = self._insert(view, frame_pose, turning_rad_s)
        covisible = self._trails.covisible(keyframe.id, frame_pose.pairs[:, 0])
        most = covisible[: 1 + self._config.links]
        # How the camera came here is measured, whoever shares more.
        if all(each.id != reference.id for each in most):
            most.append(reference)
        links = covisible_links(self.map, keyframe, most, frame_pose.hessian)
        return replace(self._placed(keyframe, np.eye(4), keyframe, links), covered=covered)

    def _placed_elsewhere(self, frame_pose: FramePose) -> TrackedFrame:
        """Return the frame placed against the keyframe that shows most of what it shows."""
        ids = frame_pose.pairs[:, 0]
        self._trails.go_to(ids)
        self._local_map.look_around(ids)
        self._near = self._trails.followed
        reference = self._near.recent[-1]
        T_map_kf = self.map.keyframes[reference.id].T_map_cam
        return self._placed(reference, se3.inverse(T_map_kf) @ frame_pose.T_map_cam)

    def _placed_again(self, view: View, frame_pose: FramePose) -> FramePose:
        """Return the last pose as the map, which has moved since, has it."""
        T_map_cam = self._trails.followed.T_odom_last
        config = self._trails.following_config
        again = refined_pose(self.map, view, T_map_cam, frame_pose.pairs, config)
        if isinstance(again, Rejection):
            return replace(frame_pose, T_map_cam=T_map_cam)
        self._trails.followed.T_odom_last = again.T_map_cam
        return again

    def _placed(
        self,
        keyframe: Keyframe,
        T_kf_cam: FloatArray,
        new: Keyframe | None = None,
        links: tuple[Link, ...] = (),
    ) -> TrackedFrame:
        """Return a frame placed against a keyframe of the map as it is now."""
        T_odom_cam = self.map.keyframes[keyframe.id].T_map_cam @ T_kf_cam
        moved: dict[int, FloatArray] = {}
        if new:
            moved = {k: self.map.keyframes[k].T_map_cam for k in sorted(self._moved)}
            self._moved = set()
        return TrackedFrame(keyframe.id, T_kf_cam, T_odom_cam, keyframe.segment, new, links, moved)

    def _needs_keyframe(self, frame_pose: FramePose, T_ref_cam: FloatArray) -> bool:
        model = self._trails.followed
        seen_by_reference = self.map.seen_by([model.recent[-1].id])
        shared = int(np.count_nonzero(is_among(frame_pose.pairs[:, 0], seen_by_reference)))
        model.most_shared = max(model.most_shared, shared)
        depth_m = self.map.median_depth_m(frame_pose.T_map_cam, frame_pose.pairs[:, 0])
        return bool(
            se3.translation_norm(T_ref_cam) > self._config.keyframe_translation * depth_m
            or np.degrees(se3.rotation_angle(T_ref_cam)) > self._config.keyframe_rotation_deg
            or shared < self._config.keyframe_inlier_share * model.most_shared
            or model is not self._near  # what is nearby has to be gathered again
        )

    def _insert(self, view: View, frame_pose: FramePose, turning_rad_s: float) -> Keyframe:
        """Make a keyframe of the view, which stays where it was placed until the map is settled."""
        model, T_map_cam = self._trails.followed, frame_pose.T_map_cam
        kept = self._memory.keep_image(preview(view.frame))  # first, for it may fail
        new_id = self._local_map.insert(view.features, T_map_cam, frame_pose.pairs)
        self._near = model
        model.last_ids = self.map.seen_by([new_id])
        features = self._memory.keep_features(self.map.placed_features(new_id))
        self.map.keyframes[new_id].features = features
        keyframe = new_keyframe(new_id, kept, features, T_map_cam, turning_rad_s, model.segment)
        self._trails.add_keyframe(keyframe)
        return keyframe

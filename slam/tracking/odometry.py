# SPDX-License-Identifier: Apache-2.0
"""RGB-D odometry: every frame is placed among the landmarks of a local map."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.config import Config, VerificationConfig
from slam.geometry import se3
from slam.geometry.features import FeatureExtractor, straightened
from slam.geometry.motion_noise import link_noise, typical_depth_m
from slam.geometry.relative_pose import estimate_relative_pose
from slam.geometry.smear import sharpness
from slam.mapping.keyframe_links import motion_between
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.mapping.landmarks import UNSEEN
from slam.mapping.local_map import LocalMap
from slam.tracking.frame_pose import FramePose, View, agreed_pose, refined_pose, track_local_map
from slam.tracking.motion_model import MotionModel
from slam.tracking.tracked_frame import TrackedFrame, new_keyframe
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
)

# How far from its place a landmark is looked for, in pixels of the finest level.
_PREDICTED_RADII_PX = (15.0, 40.0)  # where the last motion should have gone on; then wider
# A frame this much less sharp than the last so many are is not placed. The least sharp frames of
# fr1_desk, fr1_xyz and the demo have 0.64, 0.78 and 0.67 of that; with smears of 5 % of the width
# it is 0.45.
_SMEARED, _USUAL_FRAMES = 0.6, 30
_AS_USUAL = 0.5  # share of the landmarks that the frame before saw
# So many of the features wanted have to have depth. Frames of fr1_desk show 67 % and more, blurred
# by 31 pixels 21 %; blurred by 121 pixels it is less than 10 %, and nothing could be matched to it.
_WORTH_A_SEGMENT = 0.1
# A segment that a lost camera began may have begun with a hand still half before the lens: so many
# frames later it is asked again whether another segment shows the same. A jump leaves those frames
# behind, and few are left behind lightly.
_ASKED_AGAIN = (1, 2, 4, 8)
_MOST_MODELS = 2  # a lost camera is looked for where the last two left it


class RgbdOdometry:
    """Tracks a camera frame by frame and decides which frames become keyframes."""

    def __init__(
        self,
        camera: Camera,
        config: Config,
        recognize: Callable[[NDArray[np.uint8], int | None], Sequence[int]] = lambda *_: (),
    ) -> None:
        """Make an odometry that asks, if lost, which keyframes look like a (H, W, 3) RGB image.

        Those of the segment that is named are not wanted.
        """
        self._camera = camera
        self._recognize = recognize
        self._config = config.odometry
        # A frame that follows its keyframe needs less evidence than a jump across the map.
        few = config.odometry.min_inliers
        less = {"min_matches": few, "min_inliers": few, "min_inlier_ratio": 0.0, "min_support": 0.0}
        self._tracking_config = config.verification.model_copy(update=less)
        # A jump needs as much as a loop, where a frame that follows does not need more.
        more = {"min_inliers": max(few, config.verification.min_inliers)}
        self._jump_config = config.verification.model_copy(update=more)
        self._extractor = FeatureExtractor(camera, config.features)
        self._local_map = LocalMap(camera, config)
        self._worth_a_segment = _WORTH_A_SEGMENT * config.features.count
        self._keyframes: list[Keyframe] = []
        self._moved: set[int] = set()  # keyframes that were adjusted since the last new one
        self._sharpness: list[float] = []  # of the last frames
        self._segments = 0
        self._models: list[MotionModel] = []  # the last is the one that is followed
        self._near: MotionModel | None = None  # around which the local map has gathered landmarks

    @property
    def map(self) -> LandmarkMap:
        """All keyframes and landmarks so far, each segment in an odometry's frame of its own."""
        return self._local_map.whole

    def start_session(self) -> None:
        """Forget where the camera was: it may be anywhere when the next frame comes."""
        self.settle()
        self._models = []

    def track(self, frame: Frame) -> TrackedFrame | Rejection:
        """Place a frame, or say why it cannot be placed; later frames are tried all the same.

        A frame that shows enough, but nothing of what was seen last or recognized, begins a new
        segment.

        Raises:
            RecognizerError: whoever was asked to recognize the frame failed.
        """
        seen = self._extractor.extract(frame)
        self.settle()
        if not self._models:
            return self._start(View(frame, seen, self._camera))
        velocity = self._models[-1].velocity(frame.timestamp_s, shortest_s=self._camera.readout_s)
        view = View(frame, straightened(seen, self._camera, velocity), self._camera)
        if rejection := self._smeared(frame):
            return self._lost(rejection)
        frame_pose: FramePose | Rejection | None = None
        if not self._models[-1].is_cold(frame.timestamp_s):
            frame_pose = self._follow(view)
        if not isinstance(frame_pose, FramePose):
            frame_pose = self._relocalize(view)
        is_worth_more = view.with_depth >= self._worth_a_segment
        if not isinstance(frame_pose, FramePose):
            if is_worth_more:
                frame_pose = self._recognized(view) or frame_pose
        else:
            frame_pose = self._recognized_elsewhere(view) or frame_pose
        if isinstance(frame_pose, FramePose):
            return self._go_on(*self._straightened_again(view, seen, frame_pose))
        lost = self._lost(frame_pose)
        return self._start(view) if is_worth_more else lost

    def _smeared(self, frame: Frame) -> Rejection | None:
        """Say if the frame is smeared by far more than others are.

        A corner may then be seen anywhere along its smear, and all agree on the wrong place.
        """
        sharp = sharpness(frame.rgb)
        if np.isinf(sharp):  # blank, which is for others to say
            return None
        self._sharpness = [*self._sharpness, sharp][-_USUAL_FRAMES:]
        needed = _SMEARED * float(np.median(self._sharpness))
        return Rejection(RejectionReason.SMEARED, sharp, needed) if sharp < needed else None

    def _lost(self, rejection: Rejection) -> Rejection:
        for model in self._models:
            model.has_missed = True
        return rejection

    def _straightened_again(
        self, view: View, seen: Features, frame_pose: FramePose
    ) -> tuple[View, FramePose]:
        """Return view and pose by the features as seen, straightened by how the camera moves now.

        Until its pose was known, all that was known is how the camera moved before.
        """
        T_map_cam, readout_s = frame_pose.T_map_cam, self._camera.readout_s
        if readout_s == 0.0:
            return view, frame_pose
        velocity = self._models[-1].velocity_to(view.frame.timestamp_s, T_map_cam, readout_s)
        again = replace(view, features=straightened(seen, self._camera, velocity))
        refined = refined_pose(self.map, again, T_map_cam, frame_pose.pairs, self._tracking_config)
        return (again, refined) if isinstance(refined, FramePose) else (view, frame_pose)

    def settle(self) -> None:
        """Adjust the map to the last keyframe, and go on from where that puts it."""
        if adjusted := self._local_map.settle():
            self._moved.update(adjusted)
            model = self._models[-1]
            last_id = model.recent[-1].id
            model.T_odom_last = self.map.keyframes[last_id].T_map_cam
            model.last_ids = self.map.seen_by([last_id])

    def _start(self, view: View) -> TrackedFrame | Rejection:
        """Begin a segment whose origin is the view."""
        if view.with_depth < (needed := self._tracking_config.min_matches):
            return Rejection(RejectionReason.FEW_MATCHES, view.with_depth, needed)
        was_lost = bool(self._models)
        last_s = view.frame.timestamp_s
        self._go_over_to(MotionModel(self._segments, was_lost=was_lost, last_s=last_s))
        self._segments += 1
        here = FramePose(np.eye(4), empty_pairs(), np.zeros((6, 6)))
        keyframe = self._insert(view, here, turning_rad_s=0.0)
        return self._placed(keyframe, np.eye(4), keyframe)

    def _go_over_to(self, model: MotionModel) -> None:
        # A segment that no second frame followed is nothing to come back to.
        worthwhile = [model for model in self._models if model.is_followed]
        self._models = [*worthwhile[1 - _MOST_MODELS :], model]

    def _follow(self, view: View) -> FramePose | Rejection:
        """Look for what the last frame saw where it should be by now, then for all around it."""
        model, config = self._models[-1], self._tracking_config
        T_predicted = model.predict(view.frame.timestamp_s)
        last_ids = self.map.landmarks.resolve(model.last_ids)
        last_ids = np.unique(last_ids[last_ids != UNSEEN])
        best: FramePose | None = None
        for radius_px in _PREDICTED_RADII_PX:
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
        found = self._relocalize_against(model.recent[-1:], view, config)
        is_better = isinstance(found, FramePose) and len(found.pairs) > len(best.pairs)
        return found if is_better else best

    def _relocalize(self, view: View) -> FramePose | Rejection:
        """Compare the view with all features of the last keyframes, wherever it may be.

        After a jump the very last alone is compared: what else looks like the view is recognized.
        """
        is_jump = False
        for model in reversed(self._models):
            is_jump = is_jump or model.is_cold(view.frame.timestamp_s)
            config = self._jump_config if is_jump else self._tracking_config
            keyframes = model.recent[-1:] if is_jump else model.recent[::-1]
            frame_pose = self._relocalize_against(keyframes, view, config)
            if isinstance(frame_pose, FramePose):
                self._models.remove(model)
                self._models.append(model)
                return frame_pose
            is_jump = is_jump or model.is_followed  # what was before it is across the map
        return frame_pose

    def _recognized(self, view: View, but_segment: int | None = None) -> FramePose | None:
        """Compare the view with the keyframes that look like it, of whatever time and segment."""
        for k in self._recognize(view.frame.rgb, but_segment):
            keyframe = self._keyframes[k]
            frame_pose = self._relocalize_against([keyframe], view, self._jump_config)
            if isinstance(frame_pose, FramePose):
                self._go_over_to(self._model_at(keyframe))
                return frame_pose
        return None

    def _recognized_elsewhere(self, view: View) -> FramePose | None:
        """Ask, in the first frames of a segment that a lost camera began, where else that is."""
        young = self._models[-1]
        if not young.was_lost or young.frames + 1 not in _ASKED_AGAIN:
            return None
        return self._recognized(view, young.segment)

    def _model_at(self, keyframe: Keyframe) -> MotionModel:
        """Return the model of a camera that has last been where a keyframe was taken."""
        covisible = self.map.covisible_keyframes(self.map.seen_by([keyframe.id]))
        others = [k for k in covisible if k != keyframe.id][: self._config.links]
        return MotionModel(
            keyframe.segment,
            recent=[*(self._keyframes[k] for k in reversed(others)), keyframe],
            last_s=keyframe.timestamp_s,
            T_odom_last=self.map.keyframes[keyframe.id].T_map_cam,
        )

    def _relocalize_against(
        self, keyframes: Sequence[Keyframe], view: View, config: VerificationConfig
    ) -> FramePose | Rejection:
        rejections = []
        for keyframe in keyframes:
            outcome = estimate_relative_pose(
                keyframe.features, view.features, self._camera, config
            ).outcome
            if isinstance(outcome, RelativePose):
                T_odom_cam = self.map.keyframes[keyframe.id].T_map_cam @ outcome.T_ref_query
                seen_ids = self.map.seen_by([keyframe.id])
                frame_pose = track_local_map(self.map, view, T_odom_cam, seen_ids, config)
                if isinstance(frame_pose, FramePose):
                    return frame_pose
                outcome = frame_pose
            rejections.append(outcome)
        return rejections[0]

    def _go_on(self, view: View, frame_pose: FramePose) -> TrackedFrame:
        """Remember where the camera is and how it moves; make the view a keyframe if need be."""
        model = self._models[-1]
        reference = model.recent[-1]
        turning_rad_s = model.follow(view.frame.timestamp_s, frame_pose.T_map_cam)
        model.last_ids = frame_pose.pairs[:, 0]
        model.usual_inliers = len(frame_pose.pairs)
        T_kf_cam = se3.inverse(self.map.keyframes[reference.id].T_map_cam) @ frame_pose.T_map_cam
        if not self._needs_keyframe(frame_pose, T_kf_cam):
            return self._placed(reference, T_kf_cam)
        keyframe = self._insert(view, frame_pose, turning_rad_s)
        return self._placed(keyframe, np.eye(4), keyframe, self._links(keyframe, frame_pose))

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
        model = self._models[-1]
        seen_by_reference = self.map.seen_by([model.recent[-1].id])
        shared = int(np.count_nonzero(np.isin(frame_pose.pairs[:, 0], seen_by_reference)))
        model.most_shared = max(model.most_shared, shared)
        depth_m = self.map.median_depth_m(frame_pose.T_map_cam, frame_pose.pairs[:, 0])
        return bool(
            se3.translation_norm(T_ref_cam) > self._config.keyframe_translation * depth_m
            or np.degrees(se3.rotation_angle(T_ref_cam)) > self._config.keyframe_rotation_deg
            or shared < self._config.keyframe_inlier_share * model.most_shared
            or model is not self._near  # what is nearby has to be gathered again
        )

    def _insert(self, view: View, frame_pose: FramePose, turning_rad_s: float) -> Keyframe:
        """Make a keyframe of the view, which stays where it was placed until the next frame."""
        model, T_map_cam = self._models[-1], frame_pose.T_map_cam
        new_id = self._local_map.insert(view.features, view.grid, T_map_cam, frame_pose.pairs)
        model.most_shared, self._near = 0, model
        features = self.map.placed_features(new_id)
        keyframe = new_keyframe(
            new_id, view.frame, features, T_map_cam, turning_rad_s, model.segment
        )
        self._keyframes.append(keyframe)
        model.recent = [*model.recent, keyframe][-1 - self._config.links :]
        return keyframe

    def _links(self, new: Keyframe, frame_pose: FramePose) -> tuple[Link, ...]:
        """Link a new keyframe to those that share most with it, as the map holds them together."""
        covisible = self.map.covisible_keyframes(frame_pose.pairs[:, 0])
        earlier = [self._keyframes[k] for k in covisible if k != new.id]
        links: list[Link] = []
        for each in earlier[: 1 + self._config.links]:
            motion = motion_between(self.map, each.id, new.id)
            if motion is not None:
                links.append(Link(each.id, new.id, self._with_noise(motion, each, new)))
        if not links:  # it was placed by landmarks of which no keyframe sees enough
            nearest = earlier[0]
            T_near_new = se3.inverse(self.map.keyframes[nearest.id].T_map_cam) @ new.T_odom_cam
            motion = RelativePose(T_near_new, frame_pose.hessian)
            links.append(Link(nearest.id, new.id, self._with_noise(motion, nearest, new)))
        return tuple(links)

    def _with_noise(self, motion: RelativePose, *both: Keyframe) -> RelativePose:
        depth_m = typical_depth_m(*(each.features for each in both))
        return link_noise(motion, self._camera, depth_m, *(each.turning_rad_s for each in both))

# SPDX-License-Identifier: Apache-2.0
"""Where a camera was last, and where a lost one is found again."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.landmarks import UNSEEN
from slam.tracking.frame_pose import FramePose, View, pose_by_keyframes
from slam.tracking.motion_model import MotionModel
from slam.types import FloatArray, Keyframe, Rejection

Recognize = Callable[[NDArray[np.uint8], int | None], Sequence[int]]
"""Tells which keyframes look like a (H, W, 3) RGB image, those of a named segment left out."""

# A segment that a lost camera began may have begun with a hand still half before the lens: so many
# frames later it is asked again whether another segment shows the same. A jump leaves those frames
# behind, and few are left behind lightly.
_ASKED_AGAIN = (1, 2, 4, 8)
_MOST_TRAILS = 2  # a lost camera is looked for where the last two left it


class Trails:
    """The camera's last motions, one per place that it may have been lost at, the newest last."""

    def __init__(self, the_map: LandmarkMap, config: Config, recognize: Recognize) -> None:
        self._map = the_map
        self._recognize = recognize
        self._links = config.odometry.links
        # A frame that follows its keyframe needs less evidence than a jump across the map.
        few = config.odometry.min_inliers
        less = {"min_matches": few, "min_inliers": few, "min_inlier_ratio": 0.0, "min_support": 0.0}
        self.following_config = config.verification.model_copy(update=less)
        # A jump needs as much as a loop, where a frame that follows does not need more.
        more = {"min_inliers": max(few, config.verification.min_inliers)}
        self._jump_config = config.verification.model_copy(update=more)
        self._keyframes: list[Keyframe] = []  # by id
        self._models: list[MotionModel] = []

    def load(self, keyframes: Sequence[Keyframe]) -> None:
        """Begin with the keyframes of an earlier map."""
        self._keyframes = list(keyframes)

    def __bool__(self) -> bool:
        """Whether the camera was anywhere in this session."""
        return bool(self._models)

    @property
    def followed(self) -> MotionModel:
        """The motion that goes on."""
        return self._models[-1]

    def forget(self) -> None:
        """Forget where the camera was, but not the keyframes."""
        self._models = []

    def begin(self, model: MotionModel) -> None:
        """Follow a motion that begins here."""
        # A segment that no second frame followed is nothing to come back to.
        worthwhile = [each for each in self._models if each.is_followed]
        self._models = [*worthwhile[1 - _MOST_TRAILS :], model]

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Remember the next keyframe, which the camera was followed to."""
        self._keyframes.append(keyframe)
        model = self.followed
        model.most_shared = 0
        model.recent = [*model.recent, keyframe][-1 - self._links :]

    def move(self, T_new_old: Mapping[int, FloatArray]) -> None:
        """Move what was last seen from keyframes, by id, with (4, 4) motions in the map's frame."""
        for model in self._models:
            if (T := T_new_old.get(model.recent[-1].id)) is not None:
                model.T_odom_last = T @ model.T_odom_last

    def miss(self) -> None:
        """Note that a frame was nowhere."""
        for model in self._models:
            model.has_missed = True

    def covisible(self, keyframe_id: int, ids: NDArray[np.int64]) -> list[Keyframe]:
        """Return the other keyframes that see landmarks, those that see most first."""
        covisible = self._map.covisible_keyframes(ids)
        return [self._keyframes[k] for k in covisible if k != keyframe_id]

    def relocalize(self, view: View) -> FramePose | Rejection:
        """Compare the view with all features of the last keyframes, wherever it may be.

        After a jump the very last alone is compared: what else looks like the view is recognized.
        """
        is_jump = False
        for model in reversed(self._models):
            is_jump = is_jump or model.is_cold(view.frame.timestamp_s)
            config = self._jump_config if is_jump else self.following_config
            keyframes = model.recent[-1:] if is_jump else model.recent[::-1]
            frame_pose = pose_by_keyframes(self._map, view, keyframes, config)
            if isinstance(frame_pose, FramePose):
                self._models.remove(model)
                self._models.append(model)
                return frame_pose
            is_jump = is_jump or model.is_followed  # what was before it is across the map
        return frame_pose

    def recognize(self, view: View, but_segment: int | None = None) -> FramePose | None:
        """Compare the view with the keyframes that look like it, of whatever time and segment.

        Raises:
            RecognizerError: whoever was asked to recognize the image failed.
        """
        for k in self._recognize(view.frame.rgb, but_segment):
            keyframe = self._keyframes[k]
            frame_pose = pose_by_keyframes(self._map, view, [keyframe], self._jump_config)
            if isinstance(frame_pose, FramePose):
                self.begin(self._model_at(keyframe, view.frame.timestamp_s))
                return frame_pose
        return None

    def recognize_elsewhere(self, view: View) -> FramePose | None:
        """Ask, in the first frames of a segment that a lost camera began, where else that is.

        Raises:
            RecognizerError: whoever was asked to recognize the image failed.
        """
        young = self.followed
        if not young.was_lost or young.frames + 1 not in _ASKED_AGAIN:
            return None
        return self.recognize(view, young.segment)

    def go_to(self, ids: NDArray[np.int64]) -> None:
        """Follow the camera from now on by the keyframe that sees most of these landmarks."""
        self.followed.recent = self.covisible(UNSEEN, ids)[self._links :: -1]
        self.followed.most_shared = 0

    def _model_at(self, keyframe: Keyframe, now_s: float) -> MotionModel:
        """Return the model of a camera that has last been where a keyframe was taken."""
        # The clock of an earlier map may be ahead.
        last_s = keyframe.timestamp_s if keyframe.timestamp_s < now_s else -np.inf
        others = self.covisible(keyframe.id, self._map.seen_by([keyframe.id]))
        return MotionModel(
            keyframe.segment,
            recent=[*reversed(others[: self._links]), keyframe],
            last_s=last_s,
            T_odom_last=self._map.keyframes[keyframe.id].T_map_cam,
        )

# SPDX-License-Identifier: Apache-2.0
"""The part of the map that frames are tracked against, adjusted whenever a keyframe enters."""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from slam.config import Config
from slam.geometry import se3
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.map_adjustment import AdjustmentProblem, adjusted, extract_problem, write_back
from slam.types import Camera, Features, FloatArray, IntArray

_WINDOW = 10  # keyframes that are adjusted together when a new one enters
_OUTER = 10  # further ones that see the same landmarks and hold the window in place
_ROUNDS = (3, 5)  # steps of the adjustment, before and after what does not fit is dropped
# An adjustment takes about as long as so many frames, and the last of them takes it up. The others
# are placed against what it moves: the more they are, the less they fit to it afterwards.
_FRAMES_BESIDE = 3
_FUSE_RADIUS_PX = 3.0
_TRIANGULATED_WITH = 3  # keyframes that are asked what they saw of features without depth
_TRIAL_KEYFRAMES = 3  # a feature that no other of so many keyframes shows was no landmark


class LocalMap:
    """A map that grows by keyframes, and the landmarks around the last of them.

    The keyframes around a new one are adjusted in a thread of its own, and put back a number of
    frames later, or when another is to enter: tracking seldom has to wait, and what comes out does
    not depend on who was faster.

    Attributes:
        whole: all keyframes and landmarks, odometry frame.
        nearby_ids: landmarks that the last keyframe and those covisible with it see.
    """

    def __init__(self, camera: Camera, config: Config) -> None:
        self.whole = LandmarkMap(
            camera, config.features.levels, config.verification.max_descriptor_distance
        )
        self.nearby_ids: IntArray = np.zeros(0, dtype=np.int64)
        self._origins: set[int] = set()
        self._window: list[int] = []
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="adjustment")
        self._underway: Future[AdjustmentProblem] | None = None
        self._frames_left = 0

    def load(self, saved: LandmarkMap) -> None:
        """Begin with an earlier map, which is taken over, where it has its first keyframe."""
        self.whole.take_over(saved.landmarks, saved.keyframes)
        self._origins = {0}

    def look_around(self, ids: IntArray) -> None:
        """Gather the landmarks near some that are seen, without a new keyframe."""
        self.nearby_ids = self.whole.seen_by(self.whole.covisible_keyframes(ids)[:_WINDOW])

    def insert(self, features: Features, T_odom_cam: FloatArray, pairs: IntArray) -> int:
        """Add a keyframe that sees (M, 2) pairs (landmark id, feature) and return its id.

        The map has to be settled. The keyframe stays where it is put until it is settled again.
        """
        newest = self.whole.add_keyframe(features, T_odom_cam, pairs)
        covisible = self.whole.covisible_keyframes(pairs[:, 0])
        neighbours = [k for k in covisible if k != newest][: _WINDOW - 1]
        made = self.whole.add_landmarks(newest)
        for neighbour in neighbours[:_TRIANGULATED_WITH]:
            made = np.concatenate([made, self.whole.triangulate(newest, neighbour)])
        for neighbour in neighbours:
            self.whole.fuse(neighbour, made, _FUSE_RADIUS_PX)
        self._window = sorted([*neighbours, newest])
        table, ids = self.whole.landmarks, self.whole.seen_by(self._window)
        had_its_chance = table.first_keyframe[ids] + _TRIAL_KEYFRAMES <= newest
        unconfirmed = ids[had_its_chance & (table.sightings[ids] < 2)]
        table.cull(unconfirmed)
        gone = np.concatenate([unconfirmed, made[~table.is_alive[made]]])
        self.whole.forget_gone(np.unique(gone), self._window)
        if not neighbours:
            self._origins.add(newest)
        covisible = self.whole.covisible_keyframes(self.whole.seen_by(self._window))
        outer = [k for k in covisible if k not in self._window][:_OUTER]
        # The first keyframe of a segment is its origin; it moves for nobody.
        free = [k for k in self._window if k not in self._origins]
        origins = [k for k in self._window if k in self._origins]
        problem = extract_problem(self.whole, free, [*outer, *origins])
        self._underway = self._thread.submit(adjusted, problem, self.whole.camera, _ROUNDS)
        self._frames_left = _FRAMES_BESIDE
        self.nearby_ids = self.whole.seen_by(self._window)
        return newest

    def next_frame(self) -> dict[int, FloatArray]:
        """Settle if that is due by now, so many frames after a keyframe; return the same."""
        self._frames_left -= 1
        return {} if self._frames_left > 0 else self.settle()

    def settle(self) -> dict[int, FloatArray]:
        """Put keyframes where they were adjusted to; return (4, 4) T_new_old by id, if any were."""
        underway, self._underway = self._underway, None
        if underway is None:
            return {}
        keyframes = [self.whole.keyframes[k] for k in self._window]
        T_old_map = [se3.inverse(each.T_map_cam) for each in keyframes]
        write_back(self.whole, underway.result())
        self.nearby_ids = self.whole.seen_by(self._window)
        moved = [new.T_map_cam @ old for new, old in zip(keyframes, T_old_map, strict=True)]
        return dict(zip(self._window, moved, strict=True))

# SPDX-License-Identifier: Apache-2.0
"""The part of the map that the tracker looks at, kept true by adjusting it as keyframes enter."""

import numpy as np

from slam.config import Config
from slam.guided_search import FeatureGrid
from slam.landmark_map import LandmarkMap
from slam.landmarks import IntArray
from slam.map_adjustment import adjusted, put_back, take_part
from slam.types import Camera, Features, FloatArray

_WINDOW = 10  # keyframes that are adjusted together when a new one enters
_OUTER = 10  # further ones that see the same landmarks and hold the window in place
_ROUNDS = (3, 5)  # steps of the adjustment, before and after what does not fit is dropped
_FUSE_RADIUS_PX = 3.0
_TRIAL_KEYFRAMES = 3  # a feature that no other of so many keyframes shows was no landmark


class LocalMap:
    """A map that grows by keyframes, and the landmarks around the last of them.

    Attributes:
        whole: all keyframes and landmarks, odometry frame.
        nearby_ids: landmarks that the last keyframe and its company see.
    """

    def __init__(self, camera: Camera, config: Config) -> None:
        self.whole = LandmarkMap(
            camera, config.features.levels, config.verification.max_descriptor_distance
        )
        self.nearby_ids: IntArray = np.zeros(0, dtype=np.int64)
        self._origins: set[int] = set()

    def insert(
        self, features: Features, grid: FeatureGrid, T_odom_cam: FloatArray, pairs: IntArray
    ) -> int:
        """Add a keyframe that sees (M, 2) pairs (landmark id, feature) and return its id."""
        newest = self.whole.add_keyframe(features, grid, T_odom_cam, pairs)
        neighbours = [k for k in self.whole.company(pairs[:, 0]) if k != newest][: _WINDOW - 1]
        made = self.whole.add_landmarks(newest)
        for neighbour in neighbours:
            self.whole.fuse(neighbour, made, _FUSE_RADIUS_PX)
        window = sorted([*neighbours, newest])
        self._cull(window, newest)
        if neighbours:
            self._adjust(window)
        else:
            self._origins.add(newest)
        self.nearby_ids = self.whole.seen_by(window)
        return newest

    def _cull(self, window: list[int], newest: int) -> None:
        table, ids = self.whole.landmarks, self.whole.seen_by(window)
        had_its_chance = table.first_keyframe[ids] + _TRIAL_KEYFRAMES <= newest
        table.is_alive[ids[had_its_chance & (table.sightings[ids] < 2)]] = False

    def _adjust(self, window: list[int]) -> None:
        company = self.whole.company(self.whole.seen_by(window))
        outer = [k for k in company if k not in window][:_OUTER]
        # The first keyframe of a segment is its origin; it moves for nobody.
        free = [k for k in window if k not in self._origins]
        origins = [k for k in window if k in self._origins]
        part = take_part(self.whole, free, [*outer, *origins])
        put_back(self.whole, adjusted(part, self.whole.camera, _ROUNDS))

# SPDX-License-Identifier: Apache-2.0
"""The map: landmarks, the keyframes that see them, and the search for one in the other."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.config import PYRAMID_SCALE
from slam.geometry import se3
from slam.geometry.feature_grid import FeatureGrid
from slam.geometry.features import match_descriptors
from slam.geometry.reprojection import Observations, project
from slam.geometry.triangulation import triangulate
from slam.mapping.landmarks import UNSEEN, Landmarks
from slam.types import Camera, Features, FloatArray, IntArray

_MIN_COSINE = 0.5  # a landmark seen from more than 60 degrees aside looks different


@dataclass
class MappedKeyframe:
    """A keyframe of the map; where it is and what it sees is improved as the map grows.

    Attributes:
        features: its features.
        measured: what was measured of all of them.
        grid: the same, for searching.
        landmark_of: (N,) int, the landmark that each feature shows, UNSEEN where none.
        created_ids: ids of the landmarks that were created from its features.
        T_map_cam: (4, 4).
    """

    features: Features
    measured: Observations
    grid: FeatureGrid
    landmark_of: IntArray
    created_ids: IntArray
    T_map_cam: FloatArray


class LandmarkMap:
    """Landmarks and keyframes in one frame of reference."""

    def __init__(self, camera: Camera, levels: int, max_descriptor_distance: int) -> None:
        self.camera = camera
        self.landmarks = Landmarks()
        self.keyframes: list[MappedKeyframe] = []
        self._levels = levels
        self._max_distance = max_descriptor_distance

    def copy(self) -> "LandmarkMap":
        """Return a map that may be changed without changing this one."""
        copied = LandmarkMap(self.camera, self._levels, self._max_distance)
        copied.landmarks = deepcopy(self.landmarks)
        copied.keyframes = [
            replace(each, landmark_of=each.landmark_of.copy()) for each in self.keyframes
        ]
        return copied

    def search(
        self, grid: FeatureGrid, T_map_cam: FloatArray, ids: IntArray, radius_px: float
    ) -> IntArray:
        """Return (M, 2) pairs (landmark id, feature): landmarks found where they should be seen.

        The camera is thought to be at (4, 4) T_map_cam. Landmarks with (P,) ids are looked for
        within a radius that holds on the finest pyramid level and is larger on coarser ones.
        """
        table = self.landmarks
        rays = table.positions_m[ids] - T_map_cam[:3, 3]
        distances_m = np.linalg.norm(rays, axis=1)
        cosines = np.einsum("ni,ni->n", rays, table.directions[ids]) / distances_m
        points_cam_m = rays @ T_map_cam[:3, :3]
        in_view = (points_cam_m[:, 2] > 0.0) & (cosines > _MIN_COSINE)
        expected_px = np.full((len(ids), 2), -1.0)
        expected_px[in_view] = project(points_cam_m[in_view], self.camera)[0][:, :2]
        size_px = (self.camera.width, self.camera.height)
        in_view &= ((expected_px >= 0.0) & (expected_px < size_px)).all(axis=1)
        ids = ids[in_view]
        # From twice as far a feature is seen on a level twice as fine.
        coarser = np.log(table.distances_m[ids] / distances_m[in_view]) / np.log(PYRAMID_SCALE)
        octaves = np.clip(table.octaves[ids] + coarser, 0.0, self._levels - 1.0)
        pairs = grid.search(
            expected_px[in_view],
            radius_px * PYRAMID_SCALE**octaves,
            octaves,
            table.descriptors[ids],
            self._max_distance,
        )
        return np.column_stack([ids[pairs[:, 0]], pairs[:, 1]])

    def add_keyframe(
        self, features: Features, grid: FeatureGrid, T_map_cam: FloatArray, pairs: IntArray
    ) -> int:
        """Add a keyframe that sees (M, 2) pairs (landmark id, feature) and return its id."""
        new_id, count = len(self.keyframes), len(features.pixels)
        measured = Observations.of(features, np.arange(count), self.camera)
        landmark_of, created_ids = np.full(count, UNSEEN), np.zeros(0, dtype=np.int64)
        self.keyframes.append(
            MappedKeyframe(features, measured, grid, landmark_of, created_ids, T_map_cam)
        )
        self._observe(new_id, pairs)
        return new_id

    def add_landmarks(self, keyframe_id: int) -> IntArray:
        """Make landmarks of a keyframe's features that have depth and show none; return the ids."""
        keyframe = self.keyframes[keyframe_id]
        has_depth = np.isfinite(keyframe.features.depth_m)
        new = np.flatnonzero((keyframe.landmark_of == UNSEEN) & has_depth)
        positions_m = se3.transform(keyframe.T_map_cam, keyframe.features.points_m[new])
        keyframe.created_ids = self.landmarks.add(positions_m, keyframe_id)
        self._observe(keyframe_id, np.column_stack([keyframe.created_ids, new]))
        return keyframe.created_ids

    def triangulate(self, keyframe_id: int, other_id: int) -> IntArray:
        """Make landmarks of features without depth that another keyframe shows; return the ids."""
        keyframe, other = self.keyframes[keyframe_id], self.keyframes[other_id]
        mine, others = self._unplaced(keyframe), self._unplaced(other)
        pairs = match_descriptors(
            keyframe.features.descriptors[mine],
            other.features.descriptors[others],
            self._max_distance,
        )
        mine, others = mine[pairs[:, 0]], others[pairs[:, 1]]
        points_m, is_sound = triangulate(
            se3.inverse(keyframe.T_map_cam) @ other.T_map_cam,
            keyframe.measured.select(mine),
            other.measured.select(others),
            self.camera,
        )
        positions_m = se3.transform(keyframe.T_map_cam, points_m[is_sound])
        ids = self.landmarks.add(positions_m, keyframe_id)
        keyframe.created_ids = np.concatenate([keyframe.created_ids, ids])
        self._observe(other_id, np.column_stack([ids, others[is_sound]]))
        self._observe(keyframe_id, np.column_stack([ids, mine[is_sound]]))
        return ids

    def _unplaced(self, keyframe: MappedKeyframe) -> IntArray:
        """Return the features that have neither depth nor a landmark."""
        is_free = self.landmarks.resolve(keyframe.landmark_of) == UNSEEN
        return np.flatnonzero(is_free & np.isnan(keyframe.features.depth_m))

    def fuse(self, keyframe_id: int, ids: IntArray, radius_px: float) -> None:
        """Look for landmarks in a keyframe that has not seen them; two at one place become one.

        The (P,) ids are all different.
        """
        keyframe = self.keyframes[keyframe_id]
        seen = self.landmarks.resolve(keyframe.landmark_of)
        ids = ids[self.landmarks.is_alive[ids] & ~np.isin(ids, seen)]
        pairs = self.search(keyframe.grid, keyframe.T_map_cam, ids, radius_px)
        T_cam_map = se3.inverse(keyframe.T_map_cam)
        points_cam_m = se3.transform(T_cam_map, self.landmarks.positions_m[pairs[:, 0]])
        pairs = pairs[keyframe.measured.select(pairs[:, 1]).agree(points_cam_m, self.camera)]
        there = self.landmarks.resolve(keyframe.landmark_of[pairs[:, 1]])
        is_free = there == UNSEEN
        self._observe(keyframe_id, pairs[is_free])
        self.landmarks.merge(pairs[~is_free, 0], there[~is_free])

    def seen_by(self, keyframe_ids: Sequence[int]) -> IntArray:
        """Return the ids of the landmarks that any of the keyframes sees, in order."""
        seen = [self.keyframes[k].landmark_of for k in keyframe_ids]
        ids = np.unique(self.landmarks.resolve(np.concatenate([empty_pairs()[:, 0], *seen])))
        return np.asarray(ids[ids != UNSEEN])

    def covisible_keyframes(self, ids: IntArray) -> list[int]:
        """Return the keyframes that see any of the landmarks, those that see most first."""
        observers = self.landmarks.observers[ids]
        shared = np.bincount(observers[observers != UNSEEN])
        who = np.flatnonzero(shared)
        return [int(k) for k in who[np.lexsort((-who, -shared[who]))]]

    def shared_features(self, a: int, b: int) -> IntArray:
        """Return (M, 2), pairs of features of two keyframes that show the same landmark."""
        of_a, of_b = (self.landmarks.resolve(self.keyframes[k].landmark_of) for k in (a, b))
        _, in_a, in_b = np.intersect1d(of_a, of_b, return_indices=True)
        return np.asarray(np.column_stack([in_a, in_b])[of_a[in_a] != UNSEEN])

    def placed_features(self, keyframe_id: int) -> Features:
        """Return a keyframe's features, those without depth at their landmarks if they show any."""
        keyframe = self.keyframes[keyframe_id]
        ids = self.landmarks.resolve(keyframe.landmark_of)
        placed = np.flatnonzero((ids != UNSEEN) & np.isnan(keyframe.features.depth_m))
        points_m = keyframe.features.points_m.copy()
        positions_m = self.landmarks.positions_m[ids[placed]]
        points_m[placed] = se3.transform(se3.inverse(keyframe.T_map_cam), positions_m)
        return replace(keyframe.features, points_m=points_m)

    def median_depth_m(self, T_map_cam: FloatArray, ids: IntArray) -> float:
        """Return how far from a camera at (4, 4) T_map_cam landmarks are, along its axis."""
        rays = self.landmarks.positions_m[ids] - T_map_cam[:3, 3]
        return float(np.median(rays @ T_map_cam[:3, 2]))

    def move_keyframes(self, keyframe_ids: Sequence[int], T_map_kf: FloatArray) -> None:
        """Move K keyframes to (K, 4, 4) poses, and with them the landmarks that they created."""
        table = self.landmarks
        for k, T_new in zip(keyframe_ids, T_map_kf, strict=True):
            keyframe = self.keyframes[k]
            T_new_old, ids = T_new @ se3.inverse(keyframe.T_map_cam), keyframe.created_ids
            table.positions_m[ids] = se3.transform(T_new_old, table.positions_m[ids])
            table.directions[ids] = table.directions[ids] @ T_new_old[:3, :3].T
            keyframe.T_map_cam = T_new

    def _observe(self, keyframe_id: int, pairs: IntArray) -> None:
        keyframe = self.keyframes[keyframe_id]
        ids, features = pairs.T
        keyframe.landmark_of[features] = ids
        self.landmarks.see(
            ids,
            keyframe_id,
            keyframe.T_map_cam[:3, 3],
            keyframe.features.descriptors[features],
            keyframe.features.octaves[features],
        )


def empty_pairs() -> NDArray[np.int64]:
    """Return (0, 2): no landmark was found."""
    return np.zeros((0, 2), dtype=np.int64)

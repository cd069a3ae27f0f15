# SPDX-License-Identifier: Apache-2.0
"""The map: landmarks, the keyframes that see them, and the search for one in the other."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled
from slam.config import PYRAMID_SCALE
from slam.geometry import se3
from slam.geometry.feature_grid import FeatureGrid
from slam.geometry.features import match_descriptors
from slam.geometry.reprojection import Observations, pinhole
from slam.geometry.triangulation import triangulate
from slam.mapping.landmarks import UNSEEN, Landmarks, is_among
from slam.types import Camera, Features, FloatArray, IntArray

_MIN_COSINE = 0.5  # a landmark seen from more than 60 degrees aside looks different


@dataclass
class MappedKeyframe:
    """A keyframe of the map; where it is and what it sees is improved as the map grows.

    Attributes:
        features: its features.
        landmark_of: (N,) int32, the landmark that each feature shows, UNSEEN where none.
        created_ids: int32 ids of the landmarks that were created from its features.
        T_map_cam: (4, 4).
        camera: what took it where that is not the map's camera.
    """

    features: Features
    landmark_of: NDArray[np.int32]
    created_ids: NDArray[np.int32]
    T_map_cam: FloatArray
    camera: Camera | None = None


class LandmarkMap:
    """Landmarks and keyframes in one frame of reference.

    Attributes:
        camera: of the keyframes that name no other; measurements of all are as if it had made them.
        landmarks: what is seen.
        keyframes: what sees it.
    """

    def __init__(self, camera: Camera, levels: int, max_descriptor_distance: int) -> None:
        self.camera = camera
        self.landmarks = Landmarks()
        self.keyframes: list[MappedKeyframe] = []
        self._has_other_cameras = False
        self._levels = levels
        self._max_distance = max_descriptor_distance

    def copy(self) -> "LandmarkMap":
        """Return a map that may be changed without changing this one."""
        copied = LandmarkMap(self.camera, self._levels, self._max_distance)
        copied.take_over(
            deepcopy(self.landmarks),
            [replace(each, landmark_of=each.landmark_of.copy()) for each in self.keyframes],
        )
        return copied

    def take_over(self, landmarks: Landmarks, keyframes: list[MappedKeyframe]) -> None:
        """Begin with landmarks and keyframes of another map, some of other cameras perhaps."""
        self.landmarks, self.keyframes = landmarks, keyframes
        self._has_other_cameras = any(self.camera_of(each) != self.camera for each in keyframes)

    def camera_of(self, keyframe: MappedKeyframe) -> Camera:
        """Return what took a keyframe."""
        return keyframe.camera or self.camera

    def search(
        self, grid: FeatureGrid, T_map_cam: FloatArray, ids: IntArray, radius_px: float
    ) -> IntArray:
        """Return (M, 2) pairs (landmark id, feature): landmarks found where they should be seen.

        The camera is thought to be at (4, 4) T_map_cam. Landmarks with (P,) ids are looked for
        within a radius that holds on the finest pyramid level and is larger on coarser ones.
        """
        table, camera = self.landmarks, grid.camera
        in_view, expected_px, octaves = _expected_places(
            table.positions_m,
            table.directions,
            self._distances_m(ids, camera),
            table.octaves,
            ids,
            T_map_cam,
            pinhole(camera),
            (int(camera.width), int(camera.height)),
            self._levels,
        )
        pairs = grid.search(
            expected_px,
            radius_px * PYRAMID_SCALE**octaves,
            octaves,
            table.descriptors[in_view],
            self._max_distance,
        )
        return np.column_stack([in_view[pairs[:, 0]], pairs[:, 1]])

    def _distances_m(self, ids: IntArray, camera: Camera) -> NDArray[np.float32]:
        """Return (P,) from how far a camera would see landmarks as large as they were last seen."""
        distances_m = self.landmarks.distances_m[ids]
        if not self._has_other_cameras:
            return distances_m
        newest, which = np.unique(self.landmarks.observers[ids].max(axis=1), return_inverse=True)
        focal_px = [self.camera_of(self.keyframes[k]).fx for k in newest]
        return distances_m * (camera.fx / np.array(focal_px, np.float32))[which]

    def add_keyframe(self, features: Features, T_map_cam: FloatArray, pairs: IntArray) -> int:
        """Add a keyframe that sees (M, 2) pairs (landmark id, feature) and return its id."""
        new_id, count = len(self.keyframes), len(features.pixels)
        landmark_of, created_ids = np.full(count, UNSEEN, np.int32), np.zeros(0, np.int32)
        self.keyframes.append(MappedKeyframe(features, landmark_of, created_ids, T_map_cam))
        self._observe(new_id, pairs)
        return new_id

    def measured(self, keyframe_id: int) -> Observations:
        """Return what a keyframe measured of all of its features."""
        keyframe = self.keyframes[keyframe_id]
        return self._measured(keyframe, np.arange(len(keyframe.features.pixels)))

    def _measured(self, keyframe: MappedKeyframe, index: IntArray) -> Observations:
        camera = self.camera_of(keyframe)
        return Observations.of(keyframe.features, index, camera).seen_by(camera, self.camera)

    def add_landmarks(self, keyframe_id: int) -> IntArray:
        """Make landmarks of a keyframe's features that have depth and show none; return the ids."""
        keyframe = self.keyframes[keyframe_id]
        has_depth = np.isfinite(keyframe.features.depth_m)
        new = np.flatnonzero((keyframe.landmark_of == UNSEEN) & has_depth)
        points_m = keyframe.features.points_m[new].astype(np.float64)
        positions_m = se3.transform(keyframe.T_map_cam, points_m)
        ids = self.landmarks.add(positions_m, keyframe_id)
        keyframe.created_ids = ids.astype(np.int32)
        self._observe(keyframe_id, np.column_stack([ids, new]))
        return ids

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
            self._measured(keyframe, mine),
            self._measured(other, others),
            self.camera,
        )
        positions_m = se3.transform(keyframe.T_map_cam, points_m[is_sound])
        ids = self.landmarks.add(positions_m, keyframe_id)
        keyframe.created_ids = np.concatenate([keyframe.created_ids, ids.astype(np.int32)])
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
        seen = self.landmarks.distinct(keyframe.landmark_of)
        ids = ids[self.landmarks.is_alive[ids] & ~is_among(ids, seen)]
        grid = FeatureGrid(keyframe.features, self.camera_of(keyframe))
        pairs = self.search(grid, keyframe.T_map_cam, ids, radius_px)
        T_cam_map = se3.inverse(keyframe.T_map_cam)
        points_cam_m = se3.transform(T_cam_map, self.landmarks.positions_m[pairs[:, 0]])
        measured = self._measured(keyframe, pairs[:, 1])
        pairs = pairs[measured.agree(points_cam_m, self.camera)]
        there = self.landmarks.resolve(keyframe.landmark_of[pairs[:, 1]])
        is_free = there == UNSEEN
        self._observe(keyframe_id, pairs[is_free])
        self.landmarks.merge(pairs[~is_free, 0], there[~is_free])

    def forget_gone(self, ids: IntArray, keyframe_ids: Sequence[int]) -> None:
        """Forget landmarks that are culled or merged and that none but some keyframes saw."""
        ids = np.sort(ids)
        for k in keyframe_ids:
            seen = self.keyframes[k].landmark_of
            is_gone = is_among(seen, ids)
            seen[is_gone] = self.landmarks.resolve(seen[is_gone])
        for k in np.unique(self.landmarks.first_keyframe[ids]):
            creator = self.keyframes[k]
            creator.created_ids = creator.created_ids[~is_among(creator.created_ids, ids)]
        self.landmarks.give_up(ids)

    def seen_by(self, keyframe_ids: Sequence[int]) -> IntArray:
        """Return the ids of the landmarks that any of the keyframes sees, in order."""
        seen = [self.keyframes[k].landmark_of for k in keyframe_ids]
        return self.landmarks.distinct(np.concatenate([np.zeros(0, np.int32), *seen]))

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


@compiled
def _expected_places(
    positions_m: FloatArray,
    directions: NDArray[np.float32],
    distances_m: NDArray[np.float32],
    octaves: NDArray[np.uint8],
    ids: IntArray,
    T_map_cam: FloatArray,
    focal_and_centre_px: tuple[float, float, float, float],
    size_px: tuple[int, int],
    levels: int,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return (M,) those of (P,) landmarks that a camera at (4, 4) T_map_cam should see, and where.

    That is at (M, 2) pixels, on (M,) pyramid levels, which may lie between two. The (P,) distances
    are those of the ids, the other columns those of all landmarks.
    """
    fx, fy, cx, cy = focal_and_centre_px
    places, levels_there = np.empty((len(ids), 2)), np.empty(len(ids))
    in_view, count = np.empty(len(ids), np.int64), 0
    for i in range(len(ids)):
        k = ids[i]
        ray_x = positions_m[k, 0] - T_map_cam[0, 3]
        ray_y = positions_m[k, 1] - T_map_cam[1, 3]
        ray_z = positions_m[k, 2] - T_map_cam[2, 3]
        z = ray_x * T_map_cam[0, 2] + ray_y * T_map_cam[1, 2] + ray_z * T_map_cam[2, 2]
        if z <= 0.0:
            continue
        distance = np.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
        along = ray_x * directions[k, 0] + ray_y * directions[k, 1] + ray_z * directions[k, 2]
        if along <= _MIN_COSINE * distance:
            continue
        x = ray_x * T_map_cam[0, 0] + ray_y * T_map_cam[1, 0] + ray_z * T_map_cam[2, 0]
        y = ray_x * T_map_cam[0, 1] + ray_y * T_map_cam[1, 1] + ray_z * T_map_cam[2, 1]
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (0.0 <= u < size_px[0] and 0.0 <= v < size_px[1]):
            continue
        # From twice as far a feature is seen on a level twice as fine.
        coarser = np.log(distances_m[i] / distance) / np.log(PYRAMID_SCALE)
        levels_there[count] = min(max(octaves[k] + coarser, 0.0), levels - 1.0)
        places[count, 0], places[count, 1], in_view[count] = u, v, k
        count += 1
    return in_view[:count], places[:count], levels_there[:count]


def empty_pairs() -> NDArray[np.int64]:
    """Return (0, 2): no landmark was found."""
    return np.zeros((0, 2), dtype=np.int64)

# SPDX-License-Identifier: Apache-2.0
"""The map as arrays, with all that adjusting it to loops needs, and back again."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.mapping.landmark_map import LandmarkMap, MappedKeyframe
from slam.mapping.landmarks import UNSEEN, Landmarks
from slam.types import Camera, Features, FloatArray

Arrays = Mapping[str, NDArray[Any]]

FEATURES = ("pixels", "undistorted_px", "octaves", "descriptors", "depth_m", "points_m")
_LANDMARKS = (
    "positions_m",
    "descriptors",
    "octaves",
    "distances_m",
    "directions",
    "observers",
    "sightings",
)
# What holds numbers of landmarks, and of keyframes.
_OF_LANDMARKS, _OF_KEYFRAMES = ("feature_landmark", "created_landmark"), "landmark_observers"


def arrays_of_map(the_map: LandmarkMap) -> dict[str, NDArray[Any]]:
    """Return the features of all keyframes, one after the other, and the landmarks they show.

    Landmarks that are gone are left out, and the others are numbered anew, in the same order.
    """
    features = {
        f"feature_{name}": np.concatenate(list(feature_parts(the_map, name))) for name in FEATURES
    }
    return {**features, **arrays_of_landmarks(the_map)}


def feature_parts(the_map: LandmarkMap, name: str) -> Iterator[NDArray[Any]]:
    """Yield an array of features, keyframe by keyframe, for all at once may be much."""
    return (getattr(each.features, name) for each in the_map.keyframes)


def arrays_of_landmarks(the_map: LandmarkMap) -> dict[str, NDArray[Any]]:
    """Return the arrays of a map but for what its features are."""
    table, keyframes = the_map.landmarks, the_map.keyframes
    alive = np.flatnonzero(table.is_alive[: len(table)])
    number = np.full(len(table) + 1, UNSEEN, np.int32)  # the last one for UNSEEN itself
    number[alive] = np.arange(len(alive))
    created = [each.created_ids[table.is_alive[each.created_ids]] for each in keyframes]
    return {
        "feature_count": np.array([len(each.landmark_of) for each in keyframes], np.int64),
        "feature_landmark": np.concatenate(
            [number[table.resolve(each.landmark_of)] for each in keyframes]
        ),
        "created_count": np.array([len(each) for each in created], np.int64),
        "created_landmark": number[np.concatenate(created)],
        **{f"landmark_{name}": getattr(table, name)[alive] for name in _LANDMARKS},
    }


def map_of_arrays(
    arrays: Arrays,
    T_odom_kf: FloatArray,
    empty: LandmarkMap,
    cameras: Sequence[Camera] | None = None,
) -> LandmarkMap:
    """Return the map again, its keyframes at (K, 4, 4) poses, in one that was empty.

    The K cameras are the map's, unless told.

    Raises:
        KeyError, ValueError, IndexError: the arrays are not what `arrays_of_map` returns.
    """
    counts = arrays["feature_count"]
    columns = [_parts(arrays[f"feature_{name}"], counts) for name in FEATURES]
    features = [Features(*each) for each in zip(*columns, strict=True)]
    taken_by = [None] * len(features) if cameras is None else cameras
    return _filled(empty, features, arrays, list(T_odom_kf), taken_by)


def _filled(
    empty: LandmarkMap,
    features: Sequence[Features],
    arrays: Arrays,
    T_odom_kf: Sequence[FloatArray],
    cameras: Sequence[Camera | None],
) -> LandmarkMap:
    """Return a map with keyframes that have features, and landmarks as `arrays_of_landmarks`."""
    counts, created = arrays["feature_count"], arrays["created_count"]
    if not len(features) == len(counts) == len(created) == len(T_odom_kf):
        raise ValueError("keyframes")
    seen = _parts(arrays["feature_landmark"], counts)
    made = _parts(arrays["created_landmark"], created)
    keyframes = [
        MappedKeyframe(*each) for each in zip(features, seen, made, T_odom_kf, cameras, strict=True)
    ]
    columns = {name: arrays[f"landmark_{name}"] for name in _LANDMARKS}
    count = len(columns["positions_m"])
    largest = max((int(part.max()) for part in (*seen, *made) if len(part)), default=-1)
    if largest >= count or any(len(each) != count for each in columns.values()):
        raise ValueError("landmarks")
    first_keyframe = np.full(count, UNSEEN, np.int32)
    first_keyframe[arrays["created_landmark"]] = np.repeat(np.arange(len(created)), created)
    empty.take_over(Landmarks.of(**columns, first_keyframe=first_keyframe), keyframes)
    return empty


def side_by_side(maps: Sequence[LandmarkMap]) -> LandmarkMap:
    """Return the keyframes and landmarks of all maps, one map after the other, each where it was.

    Their frames have nothing to do with each other until the keyframes are moved.
    """
    parts: dict[str, list[NDArray[Any]]] = defaultdict(list)
    keyframes = landmarks = 0
    for each in maps:
        arrays = arrays_of_landmarks(each)
        for name, array in arrays.items():
            first = {**dict.fromkeys(_OF_LANDMARKS, landmarks), _OF_KEYFRAMES: keyframes}.get(name)
            shifted = array if first is None else np.where(array == UNSEEN, UNSEEN, array + first)
            parts[name].append(shifted.astype(array.dtype))
        keyframes += len(each.keyframes)
        landmarks += len(arrays["landmark_positions_m"])
    arrays = {name: np.concatenate(some) for name, some in parts.items()}
    mapped = [each for one in maps for each in one.keyframes]
    features, T_map_kf = [each.features for each in mapped], [each.T_map_cam for each in mapped]
    cameras = [one.camera_of(each) for one in maps for each in one.keyframes]
    return _filled(maps[0].copy(), features, arrays, T_map_kf, cameras)


def part_of_map(the_map: LandmarkMap, keyframe_ids: Sequence[int]) -> LandmarkMap:
    """Return the map of some keyframes alone, numbered anew in their order, in a copy."""
    part = the_map.copy()
    table = part.landmarks
    seen = np.zeros(len(table.is_alive), bool)
    seen[part.seen_by(keyframe_ids)] = True
    table.cull(np.flatnonzero(table.is_alive & ~seen))
    number = np.full(len(part.keyframes) + 1, UNSEEN, np.int32)  # the last one for UNSEEN itself
    number[list(keyframe_ids)] = np.arange(len(keyframe_ids))
    table.observers = number[table.observers]
    table.first_keyframe = number[table.first_keyframe]
    part.keyframes = [part.keyframes[k] for k in keyframe_ids]
    return part


def _parts(array: NDArray[Any], counts: NDArray[np.int64]) -> list[NDArray[Any]]:
    if len(array) != counts.sum():
        raise ValueError("features")
    return np.split(array, np.cumsum(counts)[:-1])

# SPDX-License-Identifier: Apache-2.0
"""The map as arrays, with all that adjusting it to loops needs, and back again."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.mapping.landmark_map import LandmarkMap, MappedKeyframe
from slam.mapping.landmarks import UNSEEN
from slam.types import Features, FloatArray

Arrays = Mapping[str, NDArray[Any]]

_FEATURES = ("pixels", "undistorted_px", "octaves", "descriptors", "depth_m", "points_m")
_LANDMARKS = (
    "positions_m",
    "descriptors",
    "octaves",
    "distances_m",
    "directions",
    "observers",
    "sightings",
)


def arrays_of_map(the_map: LandmarkMap) -> dict[str, NDArray[Any]]:
    """Return the features of all keyframes, one after the other, and the landmarks they show.

    Landmarks that are gone are left out, and the others are numbered anew, in the same order.
    """
    table, keyframes = the_map.landmarks, the_map.keyframes
    alive = np.flatnonzero(table.is_alive[: len(table)])
    number = np.full(len(table) + 1, UNSEEN, np.int32)  # the last one for UNSEEN itself
    number[alive] = np.arange(len(alive))
    created = [each.created_ids[table.is_alive[each.created_ids]] for each in keyframes]
    return {
        "feature_count": np.array([len(each.landmark_of) for each in keyframes], np.int64),
        **{
            f"feature_{name}": np.concatenate([getattr(each.features, name) for each in keyframes])
            for name in _FEATURES
        },
        "feature_landmark": np.concatenate(
            [number[table.resolve(each.landmark_of)] for each in keyframes]
        ),
        "created_count": np.array([len(each) for each in created], np.int64),
        "created_landmark": number[np.concatenate(created)],
        **{f"landmark_{name}": getattr(table, name)[alive] for name in _LANDMARKS},
    }


def map_of_arrays(arrays: Arrays, T_odom_kf: FloatArray, empty: LandmarkMap) -> LandmarkMap:
    """Return the map again, its keyframes at (K, 4, 4) poses, in one that was empty.

    Raises:
        KeyError, ValueError, IndexError: the arrays are not what `arrays_of_map` returns.
    """
    counts, created = arrays["feature_count"], arrays["created_count"]
    if len(counts) != len(T_odom_kf) or len(created) != len(T_odom_kf):
        raise ValueError("keyframes")
    features = [_parts(arrays[f"feature_{name}"], counts) for name in _FEATURES]
    seen = _parts(arrays["feature_landmark"], counts)
    made = _parts(arrays["created_landmark"], created)
    empty.keyframes = [
        MappedKeyframe(Features(*each), landmark_of, created_ids, T)
        for *each, landmark_of, created_ids, T in zip(*features, seen, made, T_odom_kf, strict=True)
    ]
    count = len(arrays["landmark_positions_m"])
    largest = max((int(part.max()) for part in (*seen, *made) if len(part)), default=-1)
    if largest >= count or any(len(arrays[f"landmark_{name}"]) != count for name in _LANDMARKS):
        raise ValueError("landmarks")
    empty.landmarks.add(np.asarray(arrays["landmark_positions_m"], np.float64), UNSEEN)
    for name in _LANDMARKS:
        getattr(empty.landmarks, name)[:count] = arrays[f"landmark_{name}"]
    return empty


def _parts(array: NDArray[Any], counts: NDArray[np.int64]) -> list[NDArray[Any]]:
    if len(array) != counts.sum():
        raise ValueError("features")
    return np.split(array, np.cumsum(counts)[:-1])

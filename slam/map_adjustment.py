# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a part of the map: copied out, adjusted, and put back."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.bundle_adjustment import Bundle, adjust, agreeing
from slam.landmark_map import LandmarkMap
from slam.landmarks import UNSEEN, IntArray
from slam.measurement import Measurements
from slam.types import Camera

_MIN_OBSERVERS = 2  # a point that one camera alone sees says nothing of where it is


@dataclass(frozen=True)
class MapPart:
    """Keyframes and the landmarks that tie them; it shares nothing with the map.

    Attributes:
        keyframe_ids: the bundle's K cameras.
        landmark_ids: (P,) the bundle's points.
        feature_of: (O,) the feature behind each observation.
        bundle: what is adjusted.
        fits: (O,) bool, the observations that agree with it; all until it is adjusted.
    """

    keyframe_ids: tuple[int, ...]
    landmark_ids: IntArray
    feature_of: IntArray
    bundle: Bundle
    fits: NDArray[np.bool_]


def take_part(the_map: LandmarkMap, free: Sequence[int], fixed: Sequence[int]) -> MapPart:
    """Return keyframes that may move, others that hold them in place, and what ties them.

    Where none is fixed, the first one is.
    """
    keyframe_ids = (*free, *fixed)
    camera_of, feature_of, landmark_of = _observations(the_map, keyframe_ids)
    of_free = np.isin(landmark_of, the_map.seen_by(free))
    _, inverse, observers = np.unique(landmark_of, return_inverse=True, return_counts=True)
    chosen = np.flatnonzero(of_free & (observers[inverse] >= _MIN_OBSERVERS))
    chosen = chosen[np.lexsort((camera_of[chosen], landmark_of[chosen]))]
    landmark_ids, point_of = np.unique(landmark_of[chosen], return_inverse=True)
    keyframes = [the_map.keyframes[k] for k in keyframe_ids]
    starts = np.cumsum([0, *(len(each.measured) for each in keyframes)])
    measured = Measurements.joined([each.measured for each in keyframes])
    bundle = Bundle(
        T_world_cam=np.array([each.T_map_cam for each in keyframes]),
        is_fixed=np.arange(len(keyframes)) >= len(free) if fixed else np.arange(len(keyframes)) < 1,
        points_m=the_map.landmarks.positions_m[landmark_ids],
        camera_of=camera_of[chosen],
        point_of=point_of,
        measured=measured.select(starts[camera_of[chosen]] + feature_of[chosen]),
    )
    fits = np.ones(len(chosen), dtype=bool)
    return MapPart(keyframe_ids, landmark_ids, feature_of[chosen], bundle, fits)


def adjusted(part: MapPart, camera: Camera, rounds: Sequence[int]) -> MapPart:
    """Return the part after some rounds of so many steps each; what does not fit sits one out."""
    bundle, fits = part.bundle, part.fits
    for steps in rounds:
        moved = adjust(bundle.select(fits), camera, steps)
        bundle = replace(bundle, T_world_cam=moved.T_world_cam, points_m=moved.points_m)
        fits = agreeing(bundle, camera)
    return replace(part, bundle=bundle, fits=fits)


def put_back(the_map: LandmarkMap, part: MapPart) -> None:
    """Move the map's keyframes and landmarks to where they were adjusted; drop what does not fit.

    Landmarks that were left out ride on the keyframe that made them.
    """
    bundle = part.bundle
    the_map.carry(part.keyframe_ids, bundle.T_world_cam)
    the_map.landmarks.positions_m[part.landmark_ids] = bundle.points_m
    for camera, k in enumerate(part.keyframe_ids):
        keyframe = the_map.keyframes[k]
        gone = part.feature_of[~part.fits & (bundle.camera_of == camera)]
        lost = the_map.landmarks.resolve(keyframe.landmark_of[gone])
        the_map.landmarks.sightings[lost[lost != UNSEEN]] -= 1
        keyframe.landmark_of[gone] = UNSEEN


def _observations(
    the_map: LandmarkMap, keyframe_ids: Sequence[int]
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the camera, the feature and the landmark of all that the keyframes see."""
    seen = [the_map.landmarks.resolve(the_map.keyframes[k].landmark_of) for k in keyframe_ids]
    features = [np.flatnonzero(each != UNSEEN) for each in seen]
    cameras = [np.full(len(each), i) for i, each in enumerate(features)]
    landmarks = [each[index] for each, index in zip(seen, features, strict=True)]
    return np.concatenate(cameras), np.concatenate(features), np.concatenate(landmarks)

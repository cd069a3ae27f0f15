# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of keyframes of the map: copied out, adjusted, and written back."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.geometry.reprojection import Observations
from slam.mapping.bundle_adjustment import Bundle, Motions, adjust, agreeing
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.landmarks import UNSEEN, is_among
from slam.types import Camera, FloatArray, IntArray, Link

_MIN_OBSERVERS = 2  # a point that one camera alone sees says nothing of where it is


@dataclass(frozen=True)
class AdjustmentProblem:
    """Keyframes and the landmarks that they share, copied out of the map.

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


def extract_problem(
    the_map: LandmarkMap, free: Sequence[int], fixed: Sequence[int]
) -> AdjustmentProblem:
    """Return keyframes that may move, others that hold them in place, and the landmarks they share.

    Where none is fixed, the first one is.
    """
    keyframe_ids = (*free, *fixed)
    keyframes = [the_map.keyframes[k] for k in keyframe_ids]
    seen = [the_map.landmarks.resolve(each.landmark_of) for each in keyframes]
    features = [np.flatnonzero(each != UNSEEN) for each in seen]
    camera_of = np.repeat(np.arange(len(keyframes)), [len(each) for each in features])
    feature_of = np.concatenate(features)
    landmark_of = np.concatenate([each[i] for each, i in zip(seen, features, strict=True)])
    of_free = is_among(landmark_of, the_map.seen_by(free))
    _, inverse, observers = np.unique(landmark_of, return_inverse=True, return_counts=True)
    chosen = np.flatnonzero(of_free & (observers[inverse] >= _MIN_OBSERVERS))
    chosen = chosen[np.lexsort((camera_of[chosen], landmark_of[chosen]))]
    landmark_ids, point_of = np.unique(landmark_of[chosen], return_inverse=True)
    starts = np.cumsum([0, *(len(each.landmark_of) for each in keyframes)])
    measured = Observations.joined([the_map.measured(k) for k in keyframe_ids])
    bundle = Bundle(
        T_world_cam=np.array([each.T_map_cam for each in keyframes]),
        is_fixed=np.arange(len(keyframes)) >= len(free) if fixed else np.arange(len(keyframes)) < 1,
        points_m=the_map.landmarks.positions_m[landmark_ids],
        camera_of=camera_of[chosen],
        point_of=point_of,
        measured=measured.select(starts[camera_of[chosen]] + feature_of[chosen]),
    )
    fits = np.ones(len(chosen), dtype=bool)
    return AdjustmentProblem(keyframe_ids, landmark_ids, feature_of[chosen], bundle, fits)


def adjusted(
    problem: AdjustmentProblem, camera: Camera, rounds: Sequence[int]
) -> AdjustmentProblem:
    """Return it after rounds of so many steps; observations that do not fit miss the next round."""
    bundle, fits = problem.bundle, problem.fits
    for steps in rounds:
        moved = adjust(bundle.select(fits), camera, steps)
        bundle = replace(bundle, T_world_cam=moved.T_world_cam, points_m=moved.points_m)
        fits = agreeing(bundle, camera)
    return replace(problem, bundle=bundle, fits=fits)


def write_back(the_map: LandmarkMap, problem: AdjustmentProblem) -> None:
    """Move the map's keyframes and landmarks to where they were adjusted; drop what does not fit.

    Landmarks that were left out move with the keyframe that created them.
    """
    bundle = problem.bundle
    the_map.move_keyframes(problem.keyframe_ids, bundle.T_world_cam)
    the_map.landmarks.positions_m[problem.landmark_ids] = bundle.points_m
    for camera, k in enumerate(problem.keyframe_ids):
        keyframe = the_map.keyframes[k]
        gone = problem.feature_of[~problem.fits & (bundle.camera_of == camera)]
        lost = the_map.landmarks.resolve(keyframe.landmark_of[gone])
        the_map.landmarks.sightings[lost[lost != UNSEEN]] -= 1
        keyframe.landmark_of[gone] = UNSEEN


# How far apart the pose graph leaves the two ends of a loop, and how far an adjusted map does; and
# so many covisible keyframes are searched along.
_LOOP_RADIUS_PX, _LOOP_COVISIBLE = 8.0, 5
_ADJUSTED_RADIUS_PX, _ADJUSTED_COVISIBLE = 3.0, 15
_ROUNDS = (5, 5)

MOST_KEYFRAMES = 500
"""What is adjusted at once. The work grows with the square of how often a place is seen again, and
stretch by stretch, each held in place by those around it, nothing is gained over the pose graph."""


def size_warning(keyframes: int) -> tuple[str, ...]:
    """Return a sentence if so many keyframes are more than can be adjusted at once, else none."""
    if keyframes <= MOST_KEYFRAMES:
        return ()
    return (
        f"{keyframes} keyframes are more than the {MOST_KEYFRAMES} that can be adjusted at once, so"
        " their poses are as the pose graph left them",
    )


def adjust_with_loops(
    the_map: LandmarkMap,
    keyframe_ids: Sequence[int],
    T_world_kf: FloatArray,
    loops: Sequence[tuple[int, int]],
    motions: Sequence[Link] = (),
) -> LandmarkMap:
    """Return the map moved to where the pose graph puts it, matched across the loops, and adjusted.

    It is a copy, in which K keyframes start from (K, 4, 4) poses and the others stay as they are.
    The loops are pairs of keyframe ids that show the same place; the motions are what something
    other than the images says of two keyframes.
    """
    final = the_map.copy()
    final.move_keyframes(keyframe_ids, T_world_kf)
    for match_id, query_id in loops:
        _match_again(final, query_id, match_id, _LOOP_COVISIBLE, _LOOP_RADIUS_PX)
        _match_again(final, match_id, query_id, _LOOP_COVISIBLE, _LOOP_RADIUS_PX)
    _adjust(final, keyframe_ids, motions)
    for k in keyframe_ids:
        _match_again(final, k, k, _ADJUSTED_COVISIBLE, _ADJUSTED_RADIUS_PX)
    _adjust(final, keyframe_ids, motions)
    return final


def _match_again(
    the_map: LandmarkMap, k: int, seen_from: int, count: int, radius_px: float
) -> None:
    """Look in keyframe k for what another keyframe and those that share most with it see."""
    others = the_map.covisible_keyframes(the_map.seen_by([seen_from]))[:count]
    the_map.fuse(k, the_map.seen_by([seen_from, *others]), radius_px)


def _adjust(the_map: LandmarkMap, keyframe_ids: Sequence[int], motions: Sequence[Link]) -> None:
    problem = extract_problem(the_map, keyframe_ids, [])
    if motions:
        bundle = replace(problem.bundle, motions=_between_cameras(keyframe_ids, motions))
        problem = replace(problem, bundle=bundle)
    write_back(the_map, adjusted(problem, the_map.camera, _ROUNDS))


def _between_cameras(keyframe_ids: Sequence[int], motions: Sequence[Link]) -> Motions:
    camera_of = {k: camera for camera, k in enumerate(keyframe_ids)}
    return Motions(
        np.array([camera_of[each.ref_id] for each in motions]),
        np.array([camera_of[each.query_id] for each in motions]),
        np.array([each.motion.T_ref_query for each in motions]),
        np.array([each.motion.information for each in motions]),
    )

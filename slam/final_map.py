# SPDX-License-Identifier: Apache-2.0
"""The map of a whole run: landmarks fused across the loops that hold, all adjusted at once."""

from collections.abc import Sequence
from dataclasses import replace

from slam.landmark_map import LandmarkMap
from slam.map_adjustment import adjusted, put_back, take_part
from slam.types import FloatArray, Keyframe

# The pose graph leaves this much between the two ends of a loop, and an adjusted map that much.
_LOOP_RADIUS_PX, _LOOP_COMPANY = 8.0, 5
_ADJUSTED_RADIUS_PX, _ADJUSTED_COMPANY = 3.0, 15
_ROUNDS = (5, 5, 10)

MOST_KEYFRAMES = 500
"""What is adjusted at once. The work grows with the square of how often a place is seen again, and
stretch by stretch, each held in place by those around it, nothing is gained over the pose graph."""


def too_large(keyframes: int) -> tuple[str, ...]:
    """Return a sentence if so many keyframes are more than can be adjusted at once, else none."""
    if keyframes <= MOST_KEYFRAMES:
        return ()
    return (
        f"{keyframes} keyframes are more than the {MOST_KEYFRAMES} that can be adjusted at once, so"
        " their poses are as the pose graph left them",
    )


def where_tracking_put(the_map: LandmarkMap, keyframes: Sequence[Keyframe]) -> tuple[Keyframe, ...]:
    """Return the keyframes at their last places in the tracker's map, which knows of no loop."""
    places = the_map.keyframes[: len(keyframes)]
    return tuple(
        replace(keyframe, T_odom_cam=place.T_map_cam)
        for keyframe, place in zip(keyframes, places, strict=True)
    )


def closed_map(
    the_map: LandmarkMap,
    keyframe_ids: Sequence[int],
    T_world_kf: FloatArray,
    loops: Sequence[tuple[int, int]],
) -> LandmarkMap:
    """Return the map moved to where the pose graph puts it, tied across the loops, and adjusted.

    Args:
        the_map: the tracker's map; it stays as it is.
        keyframe_ids: the K keyframes that have a place; the others stay as they are.
        T_world_kf: (K, 4, 4) their poses to start from.
        loops: pairs of keyframe ids that show the same place.
    """
    final = the_map.copy()
    final.carry(keyframe_ids, T_world_kf)
    for match_id, query_id in loops:
        _look_again(final, query_id, match_id, _LOOP_COMPANY, _LOOP_RADIUS_PX)
        _look_again(final, match_id, query_id, _LOOP_COMPANY, _LOOP_RADIUS_PX)
    _adjust(final, keyframe_ids)
    for k in keyframe_ids:
        _look_again(final, k, k, _ADJUSTED_COMPANY, _ADJUSTED_RADIUS_PX)
    _adjust(final, keyframe_ids)
    return final


def _look_again(
    the_map: LandmarkMap, k: int, seen_from: int, company: int, radius_px: float
) -> None:
    """Look in keyframe k for what another keyframe and those that share most with it see."""
    others = the_map.company(the_map.seen_by([seen_from]))[:company]
    the_map.fuse(k, the_map.seen_by([seen_from, *others]), radius_px)


def _adjust(the_map: LandmarkMap, keyframe_ids: Sequence[int]) -> None:
    part = take_part(the_map, keyframe_ids, [])
    put_back(the_map, adjusted(part, the_map.camera, _ROUNDS))

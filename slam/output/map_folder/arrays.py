# SPDX-License-Identifier: Apache-2.0
"""A map as the arrays of its files, and back again."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.geometry.keyframe_memory import compressed, kept_frame
from slam.loops.saved_map import SavedMap
from slam.loops.submaps import Loop
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.stored_map import (
    FEATURES,
    Arrays,
    arrays_of_landmarks,
    feature_parts,
    map_of_arrays,
)
from slam.types import (
    Camera,
    FloatArray,
    IntArray,
    Keyframe,
    Link,
    LoopAttempt,
    RelativePose,
    Verification,
)


class Column(NamedTuple):
    """An array in parts, which one after the other are all of it.

    Attributes:
        length: rows in all.
        parts: at least one.
    """

    length: int
    parts: Iterable[NDArray[Any]]


def columns_of(saved: SavedMap) -> dict[str, Column]:
    """Return the arrays of a map by name; what takes much is made when it is asked for."""
    keyframes, loops, attempts = saved.keyframes, saved.loops, saved.attempts
    small: dict[str, NDArray[Any]] = {
        "keyframe_timestamp_s": np.array([each.timestamp_s for each in keyframes]),
        "keyframe_T_map_cam": np.array([each.T_odom_cam for each in keyframes]),
        "keyframe_camera": _camera_numbers(saved),
        "keyframe_turning_rad_s": np.array([each.turning_rad_s for each in keyframes]),
        "keyframe_session": saved.sessions.astype(np.int64),
        "keyframe_frames": saved.frames,
        "keyframe_is_new": saved.is_new,
        **_of_motions("link", saved.links),
        **_of_motions("loop", loops),
        "loop_centre_m": np.array([each.centre_ref_m for each in loops]).reshape(-1, 3),
        "loop_radius_m": np.array([each.radius_m for each in loops], np.float64),
        "loop_similarity": np.array([each.similarity for each in attempts], np.float64),
        "loop_min_similarity": _numbers(each.min_similarity for each in attempts),
        "loop_weight": _numbers(each.weight for each in attempts),
        "loop_matches": np.array([_matches(each) for each in attempts], np.int64).reshape(-1, 2),
        **arrays_of_landmarks(saved.the_map),
    }
    columns = {name: Column(len(each), [each]) for name, each in small.items()}
    features = sum(len(each.landmark_of) for each in saved.the_map.keyframes)
    for name in FEATURES:
        columns[f"feature_{name}"] = Column(features, feature_parts(saved.the_map, name))
    columns["embedding"] = Column(len(saved.embeddings), np.split(saved.embeddings, len(keyframes)))
    for number, name in enumerate(("color_jpeg", "depth_deflated")):
        sizes = np.array([len(_contents(each, saved)[number]) for each in keyframes])
        columns[f"thumbnail_{name}_size"] = Column(len(sizes), [sizes.astype(np.int64)])
        columns[f"thumbnail_{name}"] = Column(int(sizes.sum()), _bytes_of(saved, number))
    return columns


def cameras_of(saved: SavedMap) -> list[Camera]:
    """Return the cameras of a map, in the order in which its keyframes need them."""
    return list(dict.fromkeys(each.camera or saved.camera for each in saved.keyframes))


def _camera_numbers(saved: SavedMap) -> IntArray:
    number = {camera: n for n, camera in enumerate(cameras_of(saved))}
    numbers = [number[each.camera or saved.camera] for each in saved.keyframes]
    return np.array(numbers, np.int64)


def map_of(
    arrays: Arrays,
    cameras: Sequence[Camera],
    fingerprint: str,
    config: Config,
    ledger: Sequence[str],
) -> SavedMap:
    """Return the map that arrays are, some of which may lie in files.

    Raises:
        KeyError, ValueError, IndexError: they are not what `columns_of` returns.
    """
    T_map_kf = arrays["keyframe_T_map_cam"]
    if T_map_kf.shape[1:] != (4, 4) or not len(T_map_kf):
        raise ValueError("keyframe_T_map_cam")
    camera = cameras[0]
    # Before there were several the layout had no numbers of them.
    none = np.zeros(len(T_map_kf), np.int64)
    numbers = _of_each({"keyframe_camera": none, **arrays}, "camera", len(T_map_kf))
    if numbers.min() < 0:
        raise ValueError("keyframe_camera")
    taken_by = [cameras[number] for number in numbers.tolist()]
    empty = LandmarkMap(camera, config.features.levels, config.verification.max_descriptor_distance)
    the_map = map_of_arrays(arrays, np.array(T_map_kf), empty, taken_by)
    links = [Link(*each) for each in _motions("link", arrays, len(T_map_kf))]
    loops, attempts = _loops(arrays, len(T_map_kf))
    return SavedMap(
        camera,
        fingerprint,
        tuple(_keyframes(arrays, the_map, taken_by)),
        _of_each(arrays, "session", len(T_map_kf)),
        _of_each(arrays, "frames", len(T_map_kf)),
        arrays["embedding"],
        _of_each(arrays, "is_new", len(T_map_kf)),
        tuple(links),
        tuple(loops),
        tuple(attempts),
        the_map,
        tuple(ledger),
    )


def _of_each(arrays: Arrays, name: str, count: int) -> NDArray[Any]:
    column = arrays[f"keyframe_{name}"]
    if column.shape != (count,):
        raise ValueError(f"keyframe_{name}")
    return column


def _keyframes(arrays: Arrays, the_map: LandmarkMap, cameras: Sequence[Camera]) -> list[Keyframe]:
    count = len(the_map.keyframes)
    stamps_s = _of_each(arrays, "timestamp_s", count).tolist()
    turning_rad_s = _of_each(arrays, "turning_rad_s", count).tolist()
    color, depth = (
        _cut(arrays[f"thumbnail_{name}"], arrays[f"thumbnail_{name}_size"])
        for name in ("color_jpeg", "depth_deflated")
    )
    if not len(color) == len(depth) == len(arrays["embedding"]) == count:
        raise ValueError("thumbnails")
    return [
        Keyframe(
            k,
            stamps_s[k],
            mapped.T_map_cam,
            mapped.features,
            kept_frame(
                stamps_s[k],
                camera.preview_shape,
                camera.depth_scale,
                color[k],
                depth[k],
            ),
            turning_rad_s[k],
            camera=camera,
        )
        for k, (mapped, camera) in enumerate(zip(the_map.keyframes, cameras, strict=True))
    ]


def _loops(arrays: Arrays, count: int) -> tuple[list[Loop], list[LoopAttempt]]:
    loops, attempts = [], []
    rows = zip(
        _motions("loop", arrays, count),
        arrays["loop_centre_m"],
        arrays["loop_radius_m"].tolist(),
        arrays["loop_similarity"].tolist(),
        arrays["loop_min_similarity"].tolist(),
        arrays["loop_weight"].tolist(),
        arrays["loop_matches"].tolist(),
        strict=True,
    )
    for (match, query, motion), centre_m, radius_m, similarity, needed, weight, seen in rows:
        loops.append(Loop(match, query, motion, centre_m, radius_m))
        nothing = np.zeros((0, 4), np.float32)
        is_inlier = np.arange(seen[0]) < seen[1]
        verification = Verification(motion, nothing, is_inlier, nothing[:, :3])
        attempts.append(
            LoopAttempt(
                query, match, similarity, verification, motion, _known(weight), _known(needed)
            )
        )
    return loops, attempts


def _of_motions(name: str, motions: Sequence[Link]) -> dict[str, NDArray[Any]]:
    """Return which keyframes are joined, and how they lie."""
    pairs = [(each.ref_id, each.query_id) for each in motions]
    T = [each.motion.T_ref_query for each in motions]
    information = [each.motion.information for each in motions]
    return {
        f"{name}_keyframes": np.array(pairs, np.int64).reshape(-1, 2),
        f"{name}_T_ref_query": np.array(T, np.float64).reshape(-1, 4, 4),
        f"{name}_information": np.array(information, np.float64).reshape(-1, 6, 6),
    }


def _motions(name: str, arrays: Arrays, count: int) -> list[tuple[int, int, RelativePose]]:
    pairs, T = arrays[f"{name}_keyframes"], np.array(arrays[f"{name}_T_ref_query"])
    if pairs.shape[1:] != (2,) or not ((pairs >= 0) & (pairs < count)).all():
        raise ValueError(f"{name}_keyframes")
    information = np.array(arrays[f"{name}_information"])
    return [
        (ref, query, RelativePose(*each))
        for (ref, query), *each in zip(pairs.tolist(), T, information, strict=True)
    ]


def _matches(attempt: LoopAttempt) -> tuple[int, int]:
    """Return how many matches a loop has, and how many of them agree."""
    assert attempt.verification
    is_inlier = attempt.verification.inlier_mask
    return len(is_inlier), int(is_inlier.sum())


def _numbers(values: Iterable[float | None]) -> FloatArray:
    return np.array([np.nan if each is None else each for each in values], np.float64)


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _bytes_of(saved: SavedMap, number: int) -> Iterable[NDArray[np.uint8]]:
    return (np.frombuffer(_contents(each, saved)[number], np.uint8) for each in saved.keyframes)


def _contents(keyframe: Keyframe, saved: SavedMap) -> tuple[bytes, bytes]:
    return compressed(keyframe.preview, (keyframe.camera or saved.camera).depth_scale)


def _cut(array: NDArray[Any], sizes: NDArray[np.int64]) -> list[NDArray[Any]]:
    ends = np.cumsum([0, *sizes.tolist()])
    if ends[-1] != len(array):
        raise ValueError("thumbnails")
    return [array[start:end] for start, end in pairwise(ends.tolist())]

# SPDX-License-Identifier: Apache-2.0
"""Loops between places that are not the same, as if geometry had verified them.

Those of `benchmarks/pose_graphs.py` are made in the same way, for graphs that come without images.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray, LoopAttempt, RelativePose

SCATTERED, CLUSTERS = "false-loops", "false-clusters"
"""Each claims that the later view was taken anywhere; many in a row that two ways are one."""

_IN_A_CLUSTER = 10
_FALSE_FROM = 0.05  # of the map's size, that the motion is off by
_ALIKE_RAD, _ALIKE = 0.2, 0.01  # how far apart two views are that look alike, in turns and of that
_MOST_TRIALS = 200  # for each loop that is wanted


@dataclass(frozen=True)
class Places:
    """Where false loops can lie.

    Attributes:
        T_world_kf: (4, 4) by id of the keyframes that have a place.
        true: the loops that geometry verified, of which there has to be one.
        taken: pairs (match_id, query_id) that are known otherwise.
        min_gap: keyframes that lie at least between the two of a pair.
        min_error_m: what a motion that is false is off by at least.
    """

    T_world_kf: Mapping[int, FloatArray]
    true: Sequence[LoopAttempt]
    taken: Collection[tuple[int, int]]
    min_gap: int
    min_error_m: float


def false_loops(
    places: Places, kind: str, wanted: int, rng: np.random.Generator
) -> list[LoopAttempt]:
    """Return so many, fewer where the map is too small; more begin with the same ones.

    A loop claims a motion that is off by more than 5 % of the map's size, as exactly as one of the
    true ones is known, whose evidence it shows. Those of a cluster go on along two ways that look
    alike and agree with each other as far as their noise lets them.
    """
    ids = np.array(sorted(places.T_world_kf))
    T = np.array([places.T_world_kf[k] for k in ids]).reshape(-1, 4, 4)
    length = max(2, min(_IN_A_CLUSTER, len(ids) // 4)) if kind == CLUSTERS else 1
    found: dict[tuple[int, int], LoopAttempt] = {}
    trials = _MOST_TRIALS * wanted if len(ids) > length + places.min_gap and places.true else 0
    for _ in range(trials):
        first, second = sorted(rng.choice(len(ids) - length + 1, 2, replace=False).tolist())
        T_first_second = _claimed(T, first, kind, rng)
        apart = max(length, places.min_gap)
        if second - first <= apart or not _is_false(places, T, first, second, T_first_second):
            continue
        for i in range(length):
            evidence = places.true[int(rng.integers(len(places.true)))]
            noise = rng.normal(size=6)
            pair = int(ids[first + i]), int(ids[second + i])
            if pair in places.taken or pair in found or len(found) == wanted:
                continue
            onwards = T_first_second @ se3.inverse(T[second]) @ T[second + i]
            T_match_query = se3.inverse(T[first + i]) @ T[first] @ onwards
            found[pair] = _loop(pair, T_match_query, evidence, noise if length > 1 else 0.0 * noise)
        if len(found) == wanted:
            break
    return list(found.values())


def _claimed(T: FloatArray, first: int, kind: str, rng: np.random.Generator) -> FloatArray:
    """Return where a false loop puts the second keyframe, seen from the first."""
    positions_m = T[:, :3, 3]
    corner_m, extent_m = positions_m.min(axis=0), np.ptp(positions_m, axis=0)
    if kind == CLUSTERS:
        sigma = np.repeat([_ALIKE_RAD, _ALIKE * extent_m.max()], 3)
        return se3.exp(sigma * rng.normal(size=6))
    position_m = corner_m + extent_m * rng.uniform(size=3)
    R = se3.from_quaternion(rng.normal(size=4))
    return np.asarray(se3.inverse(T[first]) @ se3.from_rotation_translation(R, position_m))


def _is_false(
    places: Places, T: FloatArray, first: int, second: int, T_first_second: FloatArray
) -> bool:
    true = se3.inverse(T[first]) @ T[second]
    error_m = np.linalg.norm(T_first_second[:3, 3] - true[:3, 3])
    size_m = np.ptp(T[:, :3, 3], axis=0).max()
    return bool(error_m > max(_FALSE_FROM * size_m, places.min_error_m))


def _loop(
    pair: tuple[int, int], T_match_query: FloatArray, evidence: LoopAttempt, noise: FloatArray
) -> LoopAttempt:
    """Return the loop as exact as another, with a (6,) standard normal error in its own units."""
    assert evidence.motion is not None and evidence.verification is not None
    information = evidence.motion.information
    sigma = np.linalg.cholesky(np.linalg.inv(information))
    motion = RelativePose(T_match_query @ se3.exp(sigma @ noise), information)
    match_id, query_id = pair
    return replace(
        evidence,
        match_id=match_id,
        query_id=query_id,
        verification=replace(evidence.verification, outcome=motion),
        outcome=motion,
    )

# SPDX-License-Identifier: Apache-2.0
"""What a run keeps of its keyframes, so that their loops can be decided again, and which remain.

With the map solved more is known than when the keyframes came: views that should overlap by where
the keyframes are, which the field calls detection by proximity, and that the run found too little
alike to look at them.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import LoopConfig
from slam.loops.atlas import shared_out
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.view_overlap import ViewOverlap
from slam.pose_graph import PoseGraph, uncertainty
from slam.result import SlamResult
from slam.types import Link, Proposal, RelativePose

# Of what two keyframes show both should see such a share. On the demo geometry verified all but one
# of 114 pairs above 0.25, every third from here to there, and nothing below 0.05.
_MIN_OVERLAP = 0.1


@dataclass(frozen=True)
class Remembered:
    """What keyframes showed: enough to look for their loops again, and to adjust the map.

    Attributes:
        min_similarity: the recognizer's own.
        embeddings: (K, D) float32, of unit length.
        the_map: its keyframes have their features.
    """

    min_similarity: float
    embeddings: NDArray[np.float32]
    the_map: LandmarkMap


@dataclass(frozen=True)
class ProposedPair:
    """Two keyframes that were not compared by geometry so far; the query is the later one."""

    query_id: int
    match_id: int
    similarity: float
    proposed_by: Proposal


def proposed_pairs(
    result: SlamResult,
    remembered: Remembered,
    candidates: Callable[[int], NDArray[np.bool_]],
    config: LoopConfig,
) -> list[ProposedPair]:
    """Return the pairs to look at next: per keyframe the best by overlap, and by similarity.

    There are `config.candidates` of either at most. Left out is what geometry was asked of, what is
    no candidate, and what is fewer than `config.min_gap` keyframes from where a loop leads: of one
    visit to a place all say the same.
    """
    overlap = _overlap(result, remembered)
    tried, tied = _tried_and_tied(result)
    found = []
    for query in range(len(result.keyframes)):
        is_open = candidates(query).copy()
        is_open[list(tried[query])] = False
        for match in tied[query]:
            _close(is_open, match, config.min_gap)
        similarities = remembered.embeddings[:query] @ remembered.embeddings[query]
        overlaps = np.zeros(query)
        placed = np.flatnonzero(is_open)
        overlaps[placed] = overlap.of(query, placed)
        overlaps[overlaps < _MIN_OVERLAP] = -np.inf
        for scores, proposed_by in (
            (overlaps, Proposal.OVERLAP),
            (similarities, Proposal.NEXT_SIMILAR),
        ):
            for _ in range(config.candidates):
                left = np.where(is_open, scores, -np.inf)
                if not len(left) or np.isneginf(left.max()):
                    break
                match = int(np.argmax(left))
                found.append(ProposedPair(query, match, float(similarities[match]), proposed_by))
                _close(is_open, match, config.min_gap)
    return found


def _close(is_open: NDArray[np.bool_], match: int, min_gap: int) -> None:
    """Leave out what is fewer than so many keyframes from a match."""
    is_open[max(0, match - min_gap + 1) : match + min_gap] = False


def _tried_and_tied(result: SlamResult) -> tuple[dict[int, set[int]], dict[int, set[int]]]:
    """Return per query the matches that geometry was asked of, and those of loops in use."""
    tried: dict[int, set[int]] = defaultdict(set)
    tied: dict[int, set[int]] = defaultdict(set)
    for attempt in result.attempts:
        if attempt.verification is not None:
            tried[attempt.query_id].add(attempt.match_id)
        if attempt.rejection is None:
            tied[attempt.query_id].add(attempt.match_id)
    return tried, tied


def _overlap(result: SlamResult, remembered: Remembered) -> ViewOverlap:
    """Return what predicts overlaps by the corrected poses and what the graph knows of them."""
    loops = {
        key: Link(each.match_id, each.query_id, each.outcome)
        for key, each in enumerate(result.attempts)
        if isinstance(each.outcome, RelativePose)
    }
    T_world_kf = result.T_world_kf
    placed = np.flatnonzero(np.isfinite(T_world_kf[:, 0, 0]))
    T_placed = {int(k): T_world_kf[k] for k in placed}
    steps = result.given.steps if result.given else ()
    known = uncertainty(PoseGraph(T_placed, result.links, shared_out(loops), steps))
    off = np.zeros((len(T_world_kf), *known.shape[1:]))
    off[placed] = known
    views = [each.features for each in remembered.the_map.keyframes]
    return ViewOverlap(views, T_world_kf, off, result.camera)

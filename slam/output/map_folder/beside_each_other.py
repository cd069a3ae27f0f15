# SPDX-License-Identifier: Apache-2.0
"""Saved maps as one that nothing joins yet, with keyframes and sessions numbered through."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from slam.loops.saved_map import SavedMap
from slam.mapping.stored_map import side_by_side
from slam.output.ledger.writing import renumbered
from slam.types import IntArray, Link


def starts_of(maps: Iterable[SavedMap]) -> IntArray:
    """Return the number of each map's first keyframe, and of how many there are in all."""
    return np.array([0, *accumulate(len(each.keyframes) for each in maps)])


def beside_each_other(maps: Sequence[SavedMap]) -> SavedMap:
    """Return all maps as one that nothing joins: each is a segment, in the frame that it was in."""
    starts = starts_of(maps).tolist()
    sessions = np.cumsum([0, *(int(each.sessions.max()) + 1 for each in maps)]).tolist()
    numbered = list(zip(starts[:-1], maps, strict=True))
    return SavedMap(
        camera=maps[0].camera,
        fingerprint=maps[0].fingerprint,
        keyframes=tuple(
            replace(
                keyframe,
                id=keyframe.id + start,
                segment=segment,
                camera=keyframe.camera or each.camera,
            )
            for segment, (start, each) in enumerate(numbered)
            for keyframe in each.keyframes
        ),
        sessions=np.concatenate(
            [each.sessions + first for first, each in zip(sessions[:-1], maps, strict=True)]
        ),
        frames=np.concatenate([each.frames for each in maps]),
        embeddings=np.concatenate([each.embeddings for each in maps]),
        is_new=np.concatenate([each.is_new for each in maps]),
        links=tuple(
            Link(link.ref_id + start, link.query_id + start, link.motion)
            for start, each in numbered
            for link in each.links
        ),
        loops=tuple(
            replace(loop, ref_id=loop.ref_id + start, query_id=loop.query_id + start)
            for start, each in numbered
            for loop in each.loops
        ),
        attempts=tuple(
            replace(one, query_id=one.query_id + start, match_id=one.match_id + start)
            for start, each in numbered
            for one in each.attempts
        ),
        the_map=side_by_side([each.the_map for each in maps]),
        ledger=tuple(renumbered(line, start) for start, each in numbered for line in each.ledger),
    )

# SPDX-License-Identifier: Apache-2.0
"""Which of many saved maps share places, as a store of places tells it: those worth merging."""

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from itertools import combinations

import numpy as np

from placerec.files import Progress
from placerec.places.store import PlaceStore
from slam.loops.saved_map import SavedMap
from slam.types import SlamError

Pair = tuple[str, str]
"""The names of two maps, in the order in which the maps were given."""

_ASKED_FOR = 10  # places that look like a keyframe
_AT_LEAST = 2  # keyframes that look like another map: loops at one place alone join none


def proposed_pairs(
    maps: Mapping[str, SavedMap],
    store: PlaceStore,
    min_similarity: float,
    progress: Progress | None = None,
) -> set[Pair]:
    """Return which two of the maps have at least two keyframes of one like places of the other.

    A map is in the store under a hash of its places, and is put there unless it is by now.

    Args:
        maps: by their names.
        store: other maps may be in it, too; what it answers of them is left aside.
        min_similarity: from which places are alike.
        progress: is told how many keyframes were asked about.

    Raises:
        SlamError: two maps have the same places.
        LoopcloseError: the store cannot be used.
    """
    names: dict[str, str] = {}
    for name, each in maps.items():
        other = names.setdefault(session := _session_of(each), name)
        if other != name:
            raise SlamError(f"{other} and {name} have the same places; leave one of them out")
        if not store.query(each.embeddings[0], 1, sessions=[session]):
            places = np.arange(len(each.keyframes))
            store.add(session, places, _times_s(each), np.array(each.embeddings))
    store.tidy()
    alike = Counter[Pair]()  # keyframes of the first that look like the second
    total, asked = sum(len(each.keyframes) for each in maps.values()), 0
    for session, name in names.items():
        own = (session, float(_times_s(maps[name]).min()))  # all of its own are left out
        for embedding in maps[name].embeddings:
            found = store.query(np.array(embedding), _ASKED_FOR, recent=own)
            close = {each.session for each in found if each.similarity >= min_similarity}
            alike.update((name, names[each]) for each in close if each in names)
            asked += 1
            if progress:
                progress(asked, total)
    return {
        pair for pair in combinations(maps, 2) if max(alike[pair], alike[pair[::-1]]) >= _AT_LEAST
    }


def largest_group(maps: Mapping[str, SavedMap], pairs: Iterable[Pair]) -> Collection[str]:
    """Return the names of the maps that pairs connect, of the group with the most keyframes."""
    groups = {name: {name} for name in maps}
    for one, other in pairs:
        both = groups[one] | groups[other]
        for name in both:
            groups[name] = both
    return max(groups.values(), key=lambda one: sum(len(maps[name].keyframes) for name in one))


def _session_of(one: SavedMap) -> str:
    digest = hashlib.sha256(_times_s(one).tobytes())
    digest.update(np.ascontiguousarray(one.embeddings).tobytes())
    return f"map-{digest.hexdigest()[:32]}"


def _times_s(one: SavedMap) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([each.timestamp_s for each in one.keyframes], np.float64)

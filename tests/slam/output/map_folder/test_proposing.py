# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import numpy as np
import pytest

from placerec.places.store import PlaceStore
from placerec.recognizers.gradients import GradientRecognizer
from slam.output.map_folder.proposing import largest_group, proposed_pairs
from slam.types import SlamError


def a_map(*places):
    """Return what is asked of a map: keyframes that each look like a place of their own number."""
    times = [SimpleNamespace(timestamp_s=float(k)) for k in range(len(places))]
    return SimpleNamespace(keyframes=times, embeddings=np.eye(16, dtype=np.float32)[list(places)])


MAPS = {
    "kitchen": a_map(0, 1, 2),
    "cellar": a_map(8, 9),
    "hall": a_map(1, 2, 3, 4),
    "attic": a_map(4, 12),  # one place in common is too few
    "stairs": a_map(3, 4, 5),
    "vault": a_map(9, 8),
}


@pytest.fixture
def store(tmp_path, needs_lancedb):
    return PlaceStore(tmp_path / "store", GradientRecognizer())


def test_maps_that_have_two_places_in_common_are_proposed_and_are_in_the_store_once(store):
    places = sum(len(each.keyframes) for each in MAPS.values())
    store.add("another robot's", [0, 1], [0.0, 1.0], np.eye(16, dtype=np.float32)[[12, 0]])
    told = []
    for _ in range(2):
        found = proposed_pairs(MAPS, store, 0.9, lambda done, total: told.append((done, total)))
        assert found == {("kitchen", "hall"), ("hall", "stairs"), ("cellar", "vault")}
        assert len(store) == places + 2
    assert told == [(n + 1, places) for n in range(places)] * 2


def test_the_same_places_twice_are_refused(store):
    with pytest.raises(SlamError, match="kitchen and copy have the same places; leave one"):
        proposed_pairs({"kitchen": MAPS["kitchen"], "copy": a_map(0, 1, 2)}, store, 0.9)


def test_the_largest_group_is_that_of_the_most_keyframes():
    pairs = {("kitchen", "hall"), ("hall", "stairs"), ("cellar", "vault")}
    assert largest_group(MAPS, pairs) == {"kitchen", "hall", "stairs"}
    assert largest_group(MAPS, set()) == {"hall"}

# SPDX-License-Identifier: Apache-2.0

from benchmarks.large_maps.made_up_places import AS_LEARNED
from benchmarks.large_maps.place_store import measure


def test_a_store_that_was_kept_is_asked_again_and_not_made_anew(tmp_path, needs_lancedb):
    made = measure(1000, 10, AS_LEARNED, tmp_path / "store_1000")
    asked = measure(1000, 10, AS_LEARNED, tmp_path / "store_1000")
    assert made["recall@10"] == asked["recall@10"] == "1.0000"
    assert asked["places"] == "1,000"
    assert "adding 100, ms" in made
    assert "adding 100, ms" not in asked

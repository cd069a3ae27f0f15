# SPDX-License-Identifier: Apache-2.0
"""Saved maps as one that nothing joins yet."""

import numpy as np

from placerec.recognizers.gradients import GradientRecognizer
from slam.output.map_folder.beside_each_other import beside_each_other, starts_of
from slam.output.map_folder.folder import load_map


def test_each_map_is_a_segment_with_numbers_of_its_own(folder):
    maps = [load_map(folder, GradientRecognizer()) for _ in range(2)]
    one, count = maps[0], len(maps[0].keyframes)
    both = beside_each_other(maps)
    assert starts_of(maps).tolist() == [0, count, 2 * count]
    assert [each.id for each in both.keyframes] == list(range(2 * count))
    assert [each.segment for each in both.keyframes] == [0] * count + [1] * count
    assert all(each.camera == one.camera for each in both.keyframes)
    assert not {*both.sessions[:count].tolist()} & {*both.sessions[count:].tolist()}
    ends = np.array([(each.ref_id, each.query_id) for each in one.links])
    shifted = np.array([(each.ref_id, each.query_id) for each in both.links])
    np.testing.assert_array_equal(shifted, np.concatenate([ends, ends + count]))
    pairs = [(each.query_id, each.match_id) for each in one.attempts]
    assert [(each.query_id, each.match_id) for each in both.attempts] == [
        *pairs,
        *((query + count, match + count) for query, match in pairs),
    ]
    assert len(both.loops) == 2 * len(one.loops) > 0
    assert len(both.ledger) == 2 * len(one.ledger) > 0

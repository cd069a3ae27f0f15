# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.large_maps.made_up_places import (
    AS_LEARNED,
    MORE_ALIKE,
    Truth,
    name_of,
    queries,
    rooms_of,
    views,
)


@pytest.mark.parametrize(
    ("likeness", "following", "again", "elsewhere", "next_room"),
    [(AS_LEARNED, 0.74, 0.51, 0.15, 0.0), (MORE_ALIKE, 0.95, 0.85, 0.57, 0.29)],
)
def test_cosines_are_spread_as_is_said(likeness, following, again, elsewhere, next_room):
    seen = np.stack([views(room, range(2), likeness) for room in range(5)])
    one, other = seen[:, 0], seen[:, 1]
    np.testing.assert_allclose(np.linalg.norm(one, axis=-1), 1.0, atol=1e-6)
    for cosines, expected in (
        (np.sum(one[:, 1:] * one[:, :-1], axis=-1), following),
        (np.sum(one * other, axis=-1), again),
        (one[:, :20] @ other[:, 70:].swapaxes(1, 2), elsewhere),
        (one[0] @ one[1].T, next_room),
    ):
        assert np.median(cosines) == pytest.approx(expected, abs=0.04)


def test_the_truth_is_what_comparing_all_finds_and_can_be_kept(tmp_path):
    asked = queries(2, 10, AS_LEARNED)
    truth, seen = Truth(asked), dict(rooms_of(2, AS_LEARNED))
    for room, places in seen.items():
        truth.add(room, places)
    every = np.concatenate([seen[room].reshape(1000, -1) for room in seen])
    best = [int(k) for k in np.argsort(-(every @ asked[3]))[:10]]
    names = [(name_of(k // 1000, k // 100 % 10), k % 100) for k in best]
    assert truth.recall(3, set(names)) == 1.0
    assert truth.recall(3, set(names[:4])) == 0.4
    truth.write(tmp_path / "truth.npy")
    again = Truth(asked)
    again.read(tmp_path / "truth.npy")
    assert again.recall(3, set(names)) == 1.0

# SPDX-License-Identifier: Apache-2.0
import numpy as np

from slam.mapping import landmarks
from slam.mapping.landmarks import UNSEEN, Landmarks, is_among


def table_of(count, keyframe_id=0):
    table = Landmarks()
    ids = table.add(np.arange(3.0 * count).reshape(-1, 3) + 1.0, keyframe_id)
    return table, ids


def see(table, ids, keyframe_id, octave=0):
    descriptors = np.full((len(ids), 32), keyframe_id, dtype=np.uint8)
    table.see(ids, keyframe_id, np.zeros(3), descriptors, np.full(len(ids), octave))


def test_rows_stay_where_they_are_while_the_table_grows():
    table, first = table_of(5)
    positions_m = table.positions_m[first].copy()
    for keyframe_id in range(1, 9):
        table.add(np.full((100, 3), float(keyframe_id)), keyframe_id)
    np.testing.assert_array_equal(table.positions_m[first], positions_m)
    assert len(table) == 805 and table.first_keyframe[804] == 8
    assert table.is_alive[:805].all()


def test_who_looks_at_a_column_while_the_table_grows_keeps_what_he_sees():
    table, first = table_of(5)
    looked_at = table.positions_m[first[0] : first[-1] + 1]
    before = looked_at.copy()
    while len(table.positions_m) < 100_000:
        table.add(np.zeros((20_000, 3)), 1)
    np.testing.assert_array_equal(looked_at, before)
    np.testing.assert_array_equal(table.positions_m[first], before)
    columns = [each for each in vars(table).values() if isinstance(each, np.ndarray)]
    assert {len(column) for column in columns} == {len(table.is_alive)}


def test_a_landmark_looks_as_the_latest_keyframe_saw_it():
    table, ids = table_of(3)
    see(table, ids, 4, octave=2)
    see(table, ids[:2], 7, octave=1)
    see(table, ids[:1], 5, octave=0)  # found in an earlier keyframe afterwards
    assert table.descriptors[ids, 0].tolist() == [7, 7, 4]
    assert table.octaves[ids].tolist() == [1, 1, 2]
    assert table.sightings[ids].tolist() == [3, 2, 1]
    distances_m = np.linalg.norm(table.positions_m[ids], axis=1)
    np.testing.assert_allclose(table.distances_m[ids], distances_m)
    np.testing.assert_allclose(table.directions[ids] * distances_m[:, None], table.positions_m[ids])


def test_the_last_eight_observers_are_remembered():
    table, ids = table_of(1)
    for keyframe_id in range(11):
        see(table, ids, keyframe_id)
    assert sorted(table.observers[ids[0]]) == list(range(3, 11))


def test_merged_landmarks_become_others_and_culled_ones_nothing():
    table, ids = table_of(5)
    for keyframe_id, each in enumerate(ids):
        see(table, np.array([each]), keyframe_id)
    table.merge(ids[[3]], ids[[1]])
    table.merge(ids[[1]], ids[[0]])
    table.is_alive[ids[4]] = False
    resolved = table.resolve(np.array([UNSEEN, 0, 1, 2, 3, 4]))
    assert resolved.tolist() == [UNSEEN, 0, 0, 2, 0, UNSEEN]
    assert table.sightings[0] == 3


def test_what_one_keyframe_tells_apart_is_not_merged():
    table, ids = table_of(3)
    see(table, ids[:2], 6)
    see(table, ids[2:], 7)
    table.merge(ids[[0]], ids[[1]])
    assert table.resolve(ids).tolist() == [0, 1, 2] and table.sightings[ids].tolist() == [1, 1, 1]
    table.merge(ids[[0]], ids[[2]])
    assert table.resolve(ids).tolist() == [2, 1, 2] and table.sightings[ids].tolist() == [1, 1, 2]


def test_which_ids_are_among_others_is_what_numpy_finds():
    rng = np.random.default_rng(0)
    for others in (np.unique(rng.integers(0, 90, 40)), np.zeros(0, np.int64)):
        ids = np.column_stack([rng.integers(-1, 100, 60)] * 2)[:, 0]
        np.testing.assert_array_equal(is_among(ids, others), np.isin(ids, others))


def test_rows_that_nobody_knows_any_more_are_used_before_the_table_grows(monkeypatch):
    monkeypatch.setattr(landmarks, "_SPARE_ROWS", 4)
    table, ids = table_of(6)  # and room for four more
    see(table, ids, 0)
    table.cull(ids[1:4])
    table.give_up(ids[1:4])
    assert table.add(np.zeros((4, 3)), 1).tolist() == [6, 7, 8, 9]
    again = table.add(np.full((2, 3), 7.0), 2)
    assert again.tolist() == [1, 2] and len(table) == len(table.is_alive) == 10
    assert table.is_alive[again].all() and not table.sightings[again].any()
    assert (table.observers[again] == UNSEEN).all() and (table.first_keyframe[again] == 2).all()
    np.testing.assert_array_equal(table.resolve(again), again)
    assert table.add(np.zeros((2, 3)), 3).tolist() == [10, 11]  # one row would not be enough
    assert table.resolve(ids).tolist() == [0, 1, 2, UNSEEN, 4, 5]

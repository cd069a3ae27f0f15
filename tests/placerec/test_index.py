# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placerec.checked_recognizer import COSINES
from placerec.errors import RecognizerError
from placerec.index import PlaceIndex, mutual_matches


def _unit(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    rows = rng.normal(size=(count, size))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 200), st.integers(1, 40), st.integers(0, 220), st.integers(0, 2**32 - 1))
def test_query_agrees_with_sorting_every_cosine(places, size, limit, seed):
    rng = np.random.default_rng(seed)
    rows, query = _unit(rng, places, size), _unit(rng, 1, size)[0]
    index = PlaceIndex()
    assert [index.add(row) for row in rows] == list(range(places))
    ids, similarities = index.query(query, 5, limit)
    true = rows.astype(float) @ query
    best = np.sort(true[:limit])[::-1][:5]
    assert len(set(ids)) == len(ids) == len(best)
    assert np.allclose(true[ids], best, atol=1e-5)
    assert np.allclose(similarities, best, atol=1e-5)
    assert (ids < limit).all()


@pytest.mark.parametrize("size", [3, 128, 496, 960])
@pytest.mark.parametrize("places", [2, 3, 50, 65, 137])
def test_equal_places_tie_and_the_earlier_one_is_first(places, size):
    row, query = _unit(np.random.default_rng(size), 2, size)
    index = PlaceIndex()
    for _ in range(places):
        index.add(row)
    ids, similarities = index.query(query, places)
    assert ids.tolist() == list(range(places))
    assert len(set(similarities.tolist())) == 1


def test_empty_index_and_empty_limit_find_nothing():
    index = PlaceIndex()
    unit = np.float32([1.0, 0.0])
    assert index.query(unit, 3)[0].shape == (0,)
    assert index.similarities().shape == (0, 0)
    index.add(unit)
    assert index.query(unit, 3, limit=0)[0].shape == (0,)


def test_remembers_a_copy():
    index = PlaceIndex()
    unit = np.float32([1.0, 0.0])
    index.add(unit)
    unit[:] = [0.0, 1.0]
    assert index.query(np.float32([1.0, 0.0]), 1)[1][0] == 1.0


def test_similarities_are_all_cosines():
    rows = _unit(np.random.default_rng(0), 70, 9)
    index = PlaceIndex()
    for row in rows:
        index.add(row)
    similarities = index.similarities()
    assert similarities.dtype == np.float32
    assert np.allclose(similarities, rows.astype(float) @ rows.T, atol=1e-6)
    assert similarities.max() <= 1.0


def test_another_size_is_refused():
    index = PlaceIndex()
    for nothing in (np.float32(1.0), np.ones((2, 0), np.float32)):
        with pytest.raises(RecognizerError, match=r"an embedding has shape \(.*\), not \(D,\)"):
            index.add(nothing)
    index.add(np.float32([1.0, 0.0]))
    with pytest.raises(RecognizerError, match=r"\(3,\).*\(2,\)"):
        index.add(np.float32([1.0, 0.0, 0.0]))
    with pytest.raises(RecognizerError, match=r"\(3,\).*\(2,\)"):
        index.query(np.float32([1.0, 0.0, 0.0]), 1)


class Sequences:
    """Compares the (2, 2) embeddings of three queries in a row with the reference's and before."""

    looks_back = 2

    def __init__(self):
        self.asked = []

    def compare(self, queries, references):
        self.asked.append((queries[:, 0, 0].tolist(), references[:, 0, 0].tolist()))
        single = COSINES.compare(queries[:, 1], references[:, 1])
        sums = np.zeros_like(single)
        for back in range(3):
            sums[back:, back:] += single[: len(single) - back, : single.shape[1] - back] / 3
        return sums


def test_a_recognizer_that_compares_sequences_is_shown_the_recent_past():
    sequences = Sequences()
    index = PlaceIndex(sequences)
    way = [0, 1, 2, 3, 2, 1, 0, 1, 2]  # there, back, and there again: places, as directions
    for number, place in enumerate(way):
        view = np.float32([[number, 0], [np.cos(place), np.sin(place)]])
        ids, similarities = index.query(view, 1, limit=number - 2)
        if number > 2:
            assert sequences.asked[-1] == ([number - 2, number - 1, number], [*range(number - 2)])
        index.add(view)
    assert ids.tolist() == [2]  # not 4, the same place on the way back
    assert similarities == pytest.approx([1.0])
    similarities = index.similarities()
    assert sequences.asked[-1] == ([*range(9)], [*range(9)])
    assert similarities[8, [2, 8]] == pytest.approx([1.0, 1.0])


def test_without_a_past_the_first_query_stands_alone():
    sequences = Sequences()
    index = PlaceIndex(sequences)
    index.add(np.ones((2, 2), np.float32))
    index.query(np.zeros((2, 2), np.float32), 1)
    assert sequences.asked == [([1.0, 0.0], [1.0])]


def test_matches_are_each_others_nearest_and_near():
    rng = np.random.default_rng(0)
    ours, theirs = rng.integers(0, 256, (2, 50, 32), np.uint8)
    theirs[[7, 30]] = ours[[20, 3]]
    theirs[30, 0] ^= 0b101
    apart = np.unpackbits(ours[:, None] ^ theirs, axis=2).sum(axis=2)
    assert mutual_matches(ours, theirs).tolist() == [[3, 30], [20, 7]]
    assert mutual_matches(ours, theirs, 1).tolist() == [[20, 7]]
    expected = [[i, j] for i, j in enumerate(apart.argmin(axis=1)) if apart[:, j].argmin() == i]
    assert mutual_matches(ours, theirs, 256).tolist() == expected
    assert mutual_matches(ours[:0], theirs).shape == (0, 2)

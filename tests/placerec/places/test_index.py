# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placerec.checked_recognizer import COSINES
from placerec.errors import RecognizerError
from placerec.places.index import PlaceIndex


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
    ids, similarities = index.query(query, 5, np.arange(places) < limit)
    true = rows.astype(float) @ query
    best = np.sort(true[:limit])[::-1][:5]
    assert len(set(ids)) == len(ids) == len(best)
    assert np.allclose(true[ids], best, atol=1e-5)
    assert np.allclose(similarities, best, atol=1e-5)
    assert (ids < limit).all()


def _noting(compare, sizes):
    def noted(queries, references):
        sizes.append(len(references))
        return compare(queries, references)

    return noted


def _alike(rng: np.random.Generator, count: int, size: int, spread: float) -> np.ndarray:
    """Return unit vectors of which some are equal, some equal but for their last bits or sign."""
    rows = np.sign(rng.normal(size=size)) + spread * rng.normal(size=(1 + count // 3, size))
    rows = rows[rng.integers(len(rows), size=count)] * rng.choice([1, 1, 1, -1], size=(count, 1))
    rows[:, 0] *= rng.choice([1.0, 1.0, 1.0 + 3e-7, 30.0], size=count)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@settings(deadline=None, max_examples=60)
@given(
    places=st.integers(1, 300),
    size=st.integers(1, 40) | st.sampled_from([128, 497, 1024]),
    spread=st.sampled_from([0.0, 1e-7, 1e-4, 1e-2, 1.0]),
    wanted=st.integers(1, 12),
    share=st.sampled_from([0.1, 0.9, 1.0]),
    block=st.sampled_from([1, 7, 64]),
    seed=st.integers(0, 2**32 - 1),
)
def test_answers_are_those_of_the_plain_comparison_to_the_last_bit(
    places, size, spread, wanted, share, block, seed
):
    rng = np.random.default_rng(seed)
    rows = _alike(rng, places + 1, size, spread)
    among = rng.random(places) < share
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("placerec.places.index._BLOCK_BYTES", block * size)
        index = PlaceIndex()
        for row in rows[:-1]:
            index.add(row)
        for query in (rows[-1], rows[0], _unit(rng, 1, size)[0]):
            every = COSINES.compare(query[None], rows[:-1])[0]
            expected = [k for k in np.argsort(-every, kind="stable") if among[k]][:wanted]
            ids, similarities = index.query(query, wanted, among)
            assert ids.tolist() == expected
            assert similarities.tobytes() == every[expected].tobytes()


def test_few_are_compared_exactly(monkeypatch):
    rows, compared = _unit(np.random.default_rng(0), 3000, 256), []
    monkeypatch.setattr(COSINES, "compare", _noting(COSINES.compare, compared))
    index = PlaceIndex()
    for row in rows[:-1]:
        index.add(row)
    index.query(rows[-1], 10)
    assert 20 <= sum(compared) < 600


def test_a_vector_of_very_many_values_does_not_overflow():
    size = 200_000
    row = np.where(np.arange(size) % 2, 1.0, -1.0).astype(np.float32) / np.float32(np.sqrt(size))
    unlike = np.where(np.arange(size) < size // 2, row, -row)
    index = PlaceIndex()
    for each in (unlike, row, unlike):
        index.add(each)
    ids, similarities = index.query(row, 1)
    assert ids.tolist() == [1] and similarities == pytest.approx([1.0], abs=1e-5)
    assert index.query(-row, 2)[0].tolist() == [0, 2]


def test_a_vector_of_zeros_is_like_nothing():
    index = PlaceIndex()
    for each in ([0.0, 0.0], [-1.0, 0.0], [1.0, 0.0]):
        index.add(np.float32(each))
    assert index.query(np.float32([1.0, 0.0]), 2)[0].tolist() == [2, 0]
    assert index.query(np.float32([0.0, 0.0]), 2)[0].tolist() == [0, 1]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_rounding_takes_beyond_one_ties_there(sign):
    index = PlaceIndex()
    for length in (1.0005, 1.0, 1.001):
        index.add(np.float32([sign * length, 0.0]))
    ids, similarities = index.query(np.float32([1.0, 0.0]), 2)
    assert ids.tolist() == [0, 1] and similarities.tolist() == [sign, sign]


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


def test_selected_places_answer_as_if_they_were_alone():
    rng = np.random.default_rng(0)
    rows, query = _unit(rng, 30, 8), _unit(rng, 1, 8)[0]
    whole, alone, ids = PlaceIndex(), PlaceIndex(), np.array([3, 7, 20, 21])
    for row in rows:
        whole.add(row)
    for row in rows[ids]:
        alone.add(row)
    chosen = whole.select(ids)
    for found, expected in zip(chosen.query(query, 3), alone.query(query, 3), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert len(chosen) == 4 and len(whole) == 30


def test_an_empty_index_and_nothing_to_look_at_find_nothing():
    index = PlaceIndex()
    unit = np.float32([1.0, 0.0])
    assert index.query(unit, 3)[0].shape == (0,)
    assert index.similarities().shape == (0, 0)
    index.add(unit)
    assert index.query(unit, 3, among=np.array([False]))[0].shape == (0,)


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
    assert index.similarities(step=3).tobytes() == similarities[::3, ::3].tobytes()


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
        ids, similarities = index.query(view, 1, among=np.arange(number) < number - 2)
        if number > 2:
            assert sequences.asked[-1] == ([number - 2, number - 1, number], [*range(number - 2)])
        index.add(view)
    assert ids.tolist() == [2]  # not 4, the same place on the way back
    assert similarities == pytest.approx([1.0])
    similarities = index.similarities()
    assert sequences.asked[-1] == ([*range(9)], [*range(9)])
    assert similarities[8, [2, 8]] == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("step", [1, 2, 3, 7])
@pytest.mark.parametrize("at_once", [1, 30, 60, 1000])
def test_sequences_are_compared_whole_even_where_few_places_are_shown(step, at_once, monkeypatch):
    monkeypatch.setattr("placerec.places.index._ANSWERED_AT_ONCE", at_once)
    rng = np.random.default_rng(0)
    rows = np.stack([np.repeat(np.arange(13.0)[:, None], 2, axis=1), _unit(rng, 13, 2)], axis=1)
    sequences = Sequences()
    index = PlaceIndex(sequences)
    for row in rows.astype(np.float32):
        index.add(row)
    similarities = index.similarities(step)
    assert len(sequences.asked) == -(-len(similarities) // max(1, at_once // (13 * step)))
    whole = Sequences().compare(rows, rows)
    np.testing.assert_allclose(similarities, whole[::step, ::step], atol=1e-6)


def test_without_a_past_the_first_query_stands_alone():
    sequences = Sequences()
    index = PlaceIndex(sequences)
    index.add(np.ones((2, 2), np.float32))
    index.query(np.zeros((2, 2), np.float32), 1)
    assert sequences.asked == [([1.0, 0.0], [1.0])]

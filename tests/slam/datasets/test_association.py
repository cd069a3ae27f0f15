# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam.datasets.association import associate, smallest_gap_s

# Whole milliseconds: sums and differences stay exact, so "as close as" has one meaning.
stamps = st.lists(st.integers(0, 400), min_size=1, max_size=30, unique=True).map(
    lambda values: np.array(sorted(values), dtype=np.float64)
)


def all_pairs_best_first(
    first: np.ndarray, second: np.ndarray, limit: float
) -> list[tuple[int, int]]:
    gaps = np.abs(first[:, None] - second[None, :])
    candidates = sorted(
        (gaps[i, k], min(first[i], second[k]), i, k) for i, k in np.argwhere(gaps <= limit)
    )
    used_first: set[int] = set()
    used_second: set[int] = set()
    pairs = []
    for _, _, i, k in candidates:
        if i not in used_first and k not in used_second:
            used_first.add(i)
            used_second.add(k)
            pairs.append((int(i), int(k)))
    return sorted(pairs)


@given(stamps, stamps, st.integers(1, 500))
def test_pairs_are_those_of_trying_all_combinations_best_first(
    first: np.ndarray, second: np.ndarray, limit: int
) -> None:
    pairs = associate(first, second, float(limit))
    assert [tuple(pair) for pair in pairs.tolist()] == all_pairs_best_first(first, second, limit)


@given(stamps, stamps)
def test_the_smallest_gap_is_the_smallest_of_all(first: np.ndarray, second: np.ndarray) -> None:
    assert smallest_gap_s(first, second) == np.abs(first[:, None] - second[None, :]).min()


def test_no_pairs_have_the_shape_of_pairs() -> None:
    assert associate(np.array([0.0]), np.array([1.0]), 0.5).shape == (0, 2)


def test_the_closer_one_gets_the_partner() -> None:
    pairs = associate(np.array([0.0, 1.0]), np.array([0.9]), 2.0)
    assert pairs.tolist() == [[1, 0]]


def test_a_limit_longer_than_the_recording_pairs_it_all() -> None:
    first = np.arange(5000) / 30.0
    pairs = associate(first, first + 0.001, 1e9)
    assert (pairs[:, 0] == pairs[:, 1]).all()
    assert len(pairs) == 5000

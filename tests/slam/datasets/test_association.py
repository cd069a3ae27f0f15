# SPDX-License-Identifier: Apache-2.0
from functools import cache

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam.datasets.tum import associate, smallest_gap_s

# Whole milliseconds: sums and differences stay exact, so "as close as" has one meaning.
stamps = st.lists(st.integers(0, 400), min_size=1, max_size=7, unique=True).map(
    lambda values: np.array(sorted(values), dtype=np.float64)
)


def best_of_all_pairings(first: np.ndarray, second: np.ndarray, limit: float) -> tuple[int, float]:
    """Try every way to pair in the order of time; return (pairs, minus total difference)."""

    @cache
    def best(i: int, k: int) -> tuple[int, float]:
        if i == len(first) or k == len(second):
            return 0, 0.0
        options = [best(i + 1, k), best(i, k + 1)]
        gap = abs(first[i] - second[k])
        if gap <= limit:
            count, cost = best(i + 1, k + 1)
            options.append((count + 1, cost - gap))
        return max(options)

    return best(0, 0)


@given(stamps, stamps, st.integers(1, 60))
def test_no_other_pairing_has_more_or_closer_pairs(
    first: np.ndarray, second: np.ndarray, limit: int
) -> None:
    pairs = associate(first, second, float(limit))
    gaps = np.abs(first[pairs[:, 0]] - second[pairs[:, 1]])
    assert (gaps <= limit).all()
    assert (np.diff(pairs, axis=0) > 0).all()
    assert (len(pairs), -gaps.sum()) == best_of_all_pairings(first, second, float(limit))


@given(stamps, stamps)
def test_the_smallest_gap_is_the_smallest_of_all(first: np.ndarray, second: np.ndarray) -> None:
    assert smallest_gap_s(first, second) == np.abs(first[:, None] - second[None, :]).min()


def test_no_pairs_have_the_shape_of_pairs() -> None:
    assert associate(np.array([0.0]), np.array([1.0]), 0.5).shape == (0, 2)


def test_the_closer_one_gets_the_partner() -> None:
    pairs = associate(np.array([0.0, 1.0]), np.array([0.9]), 2.0)
    assert pairs.tolist() == [[1, 0]]


def test_streams_half_a_period_out_of_step_lose_no_frame() -> None:
    first = np.arange(300) / 30.0
    jitter = np.where(np.arange(300) % 2, 0.001, -0.001)
    assert len(associate(first, first + 1 / 60 + jitter, 0.02)) == 300


def test_a_limit_longer_than_the_recording_pairs_it_all() -> None:
    first = np.arange(5000) / 30.0
    pairs = associate(first, first + 0.001, 1e9)
    assert (pairs[:, 0] == pairs[:, 1]).all()
    assert len(pairs) == 5000

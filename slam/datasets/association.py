# SPDX-License-Identifier: Apache-2.0
"""Which entries of two lists of timestamps belong together."""

from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from slam.types import FloatArray


def associate(
    first_s: FloatArray, second_s: FloatArray, max_difference_s: float
) -> NDArray[np.intp]:
    """Return (M, 2) indices of paired timestamps, closest pairs first served, each used once.

    Takes (N,) and (K,) increasing timestamps, seconds; the pairs come in the order of time. In
    O((N + K) log(N + K)): the closest two of what is left are always neighbours in time.
    """
    times_s = np.concatenate([first_s, second_s])
    order = np.argsort(times_s, kind="stable")
    sorted_s = times_s[order].tolist()
    is_first = (order < len(first_s)).tolist()
    n = len(order)
    before, after = list(range(-1, n - 1)), list(range(1, n + 1))
    gaps = [
        (sorted_s[i + 1] - sorted_s[i], i, i + 1)
        for i in range(n - 1)
        if is_first[i] != is_first[i + 1]
    ]
    heapify(gaps)
    partner: dict[int, int] = {}
    while gaps and gaps[0][0] <= max_difference_s:
        _, left, right = heappop(gaps)
        if left in partner or right in partner:
            continue
        partner[left], partner[right] = right, left
        left, right = before[left], after[right]
        if left >= 0:
            after[left] = right
        if right < n:
            before[right] = left
        if left >= 0 and right < n and is_first[left] != is_first[right]:
            heappush(gaps, (sorted_s[right] - sorted_s[left], left, right))
    pairs = [(order[i], order[k] - len(first_s)) for i, k in partner.items() if is_first[i]]
    return np.array(sorted(pairs), dtype=np.intp).reshape(-1, 2)


def smallest_gap_s(first_s: FloatArray, second_s: FloatArray) -> float:
    """Return the smallest difference, seconds, between (N,) and (K,) increasing timestamps."""
    times_s = np.concatenate([first_s, second_s])
    order = np.argsort(times_s)
    is_first = order < len(first_s)
    return float(np.diff(times_s[order])[is_first[1:] != is_first[:-1]].min())

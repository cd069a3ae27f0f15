# SPDX-License-Identifier: Apache-2.0
"""The sparse matrix of a pose graph's normal equations, in blocks of six, and its factors."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from slam.types import FloatArray, IntArray

_ANCHOR_INFORMATION = 1e8
# Where weights hardly changed, a step is found with the factors of an earlier one, applied up to so
# many times; new ones may be so often before all motions are taken into them.
_REPEATS, _MOST_REPEATS = 30, 2000
_WORTH_REUSING = 500  # poses: with fewer of them new factors of everything cost least
# What weighs less than such a share of the heaviest is left to repeats, the more of it the thicker
# the factors would be: of so many blocks a pose they are thin.
_SHARES, _THIN = (0.05, 0.1, 0.2, 0.4, 0.8), 20
# What is factorised is symmetric and positive definite: no row has to be exchanged for another.
_POSITIVE = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


@dataclass(frozen=True)
class _Layout:
    """An order of elimination for those blocks that are not zero.

    Attributes:
        is_there: (B,) bool, which blocks these are, by rows.
        place_of: (K,) where a pose is in the order.
        order: the blocks that are there, by rows of the order.
        columns, starts: where each of them is, and where a row of them begins.
        fill: how many blocks a factor has.
    """

    is_there: NDArray[np.bool_]
    place_of: IntArray
    order: IntArray
    columns: IntArray
    starts: IntArray
    fill: int


@dataclass(frozen=True)
class _Factors:
    """A factorised matrix."""

    layout: _Layout
    lu: SuperLU

    def solve(self, right: FloatArray) -> FloatArray:
        """Return what the matrix takes to (6 K,) or (6 K, D) right."""
        place_of = self.layout.place_of
        in_place = np.empty((len(place_of), 6, *right.shape[1:]))
        in_place[place_of] = right.reshape(in_place.shape)
        solution = self.lu.solve(in_place.reshape(right.shape))
        return np.asarray(solution.reshape(in_place.shape)[place_of].reshape(right.shape))


class BlockMatrix:
    """A (6 K, 6 K) matrix of the blocks that motions between K poses add to, the first one held.

    False loops tie together what is far apart, and to eliminate them may cost hundreds of times
    what all others do. They have little weight, so factors need not know of them: repeats do.
    """

    def __init__(self, ref: IntArray, query: IntArray, count: int) -> None:
        ends, held = (ref, query), np.zeros(1, np.int64)
        rows = np.concatenate([*(a for a in ends for _ in ends), held])
        columns = np.concatenate([*(b for _ in ends for b in ends), held])
        places, block_of = np.unique(rows * count + columns, return_inverse=True)
        shape = (len(places), len(block_of))
        ones = np.ones(len(block_of))
        self._sum = scipy.sparse.csr_array((ones, (block_of, np.arange(len(ones)))), shape=shape)
        self._count = count
        self._rows, self._columns = np.divmod(places, count)
        self._starts = np.searchsorted(places, count * np.arange(count + 1))
        self._layout: _Layout | None = None
        self._factors: _Factors | None = None

    def solved(
        self, blocks: list[FloatArray], right: FloatArray, rest: float, weights: FloatArray
    ) -> FloatArray:
        """Return (K, 6), what the matrix takes to (K, 6) right, but for a rest of such a share.

        Its blocks are (M, 6, 6) each: from reference to itself, to query, and from that to both.
        Of the motions those that weigh most, by (M,) weights, lead to the solution soon.
        """
        summed, right = self._summed(blocks), right.ravel()
        if self._count < _WORTH_REUSING:
            return self._factorised(summed).solve(right).reshape(-1, 6)
        solution = self._nearly(summed, right, rest, _REPEATS)
        if solution is None:
            self._factors = self._factorised(self._heaviest(blocks, weights))
            solution = self._nearly(summed, right, rest, _MOST_REPEATS)
        if solution is None:
            self._factors = self._factorised(summed)
            solution = self._factors.solve(right)
        return solution.reshape(-1, 6)

    def solved_anew(self, blocks: list[FloatArray], right: FloatArray) -> FloatArray:
        """Return the same for (K, 6, D) right; what was factorised for one stays as it was."""
        factors = self._factorised(self._summed(blocks))
        return factors.solve(right.reshape(6 * len(right), -1)).reshape(right.shape)

    def _summed(self, blocks: list[FloatArray]) -> FloatArray:
        """Return (B, 6, 6), the blocks of the matrix by rows."""
        added = np.concatenate([*blocks, _ANCHOR_INFORMATION * np.eye(6)[None]]).reshape(-1, 36)
        return np.asarray((self._sum @ added).reshape(-1, 6, 6))

    def _heaviest(self, blocks: list[FloatArray], weights: FloatArray) -> FloatArray:
        """Return (B, 6, 6), the blocks by the heaviest motions alone, the fewer the thicker."""
        used = 0
        for share in _SHARES:
            is_heavy = weights >= share * weights.max()
            if is_heavy.sum() == used:
                continue
            used = int(is_heavy.sum())
            summed = self._summed([each * is_heavy[:, None, None] for each in blocks])
            if self._layout_of(summed).fill < _THIN * self._count:
                break
        return summed

    def _factorised(self, summed: FloatArray) -> _Factors:
        layout, size = self._layout_of(summed), 6 * self._count
        parts = (summed[layout.order], layout.columns, layout.starts)
        by_rows = scipy.sparse.bsr_array(parts, shape=(size, size)).tocsr()
        # It is symmetric, so its rows are its columns.
        columns = (by_rows.data, by_rows.indices, by_rows.indptr)
        matrix = scipy.sparse.csc_array(columns, shape=(size, size))
        return _Factors(layout, splu(matrix, permc_spec="NATURAL", **_POSITIVE))

    def _layout_of(self, summed: FloatArray) -> _Layout:
        """Return the layout of blocks, of which those of zeros alone do not count."""
        is_there = np.asarray(summed.any(axis=(1, 2)))
        if self._layout is None or (self._layout.is_there != is_there).any():
            at, count = np.flatnonzero(is_there), self._count
            place_of, fill = _elimination_order(self._rows[at], self._columns[at], count)
            places = place_of[self._rows[at]] * count + place_of[self._columns[at]]
            by_place = np.argsort(places)
            places = places[by_place]
            starts = np.searchsorted(places, count * np.arange(count + 1))
            parts = (at[by_place], places % count, starts, fill)
            self._layout = _Layout(is_there, place_of, *parts)
        return self._layout

    def _nearly(
        self, summed: FloatArray, right: FloatArray, rest: float, repeats: int
    ) -> FloatArray | None:
        """Return the solution if the factors of a matrix like it lead there soon, else None."""
        if self._factors is None:
            return None
        parts = (summed, self._columns, self._starts)
        matrix = scipy.sparse.bsr_array(parts, shape=(len(right), len(right)))
        factors = LinearOperator(matrix.shape, self._factors.solve, dtype=np.float64)
        solution, is_left = cg(matrix, right, rtol=rest, maxiter=repeats, M=factors)
        return None if is_left else np.asarray(solution)


def _elimination_order(rows: IntArray, columns: IntArray, count: int) -> tuple[IntArray, int]:
    """Return (K,) places of poses in an order whose elimination fills in little, and how much.

    It is that of minimum degree on the graph of the poses, six times smaller than their matrix.
    """
    apart = rows != columns
    all_poses = np.arange(count)
    degrees = 1.0 + np.bincount(rows[apart], minlength=count)
    values = np.concatenate([np.full(np.count_nonzero(apart), -1.0), degrees])
    at = (np.concatenate([rows[apart], all_poses]), np.concatenate([columns[apart], all_poses]))
    pattern = scipy.sparse.coo_array((values, at), shape=(count, count)).tocsc()
    factors = splu(pattern, permc_spec="MMD_AT_PLUS_A", **_POSITIVE)
    return factors.perm_c.astype(np.int64), factors.nnz // 2

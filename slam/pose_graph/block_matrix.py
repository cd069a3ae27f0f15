# SPDX-License-Identifier: Apache-2.0
"""The sparse matrix of a pose graph's normal equations, in blocks of six, and its factors."""

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from slam.types import FloatArray, IntArray

_ANCHOR_INFORMATION = 1e8
# Where weights hardly changed, a step is found with the factors of an earlier one, applied up to so
# many times. In a small graph new factors cost less.
_MOST_REPEATS = 30
_WORTH_REUSING = 500
# What is factorised is symmetric and positive definite: no row has to be exchanged for another.
_POSITIVE = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


class BlockMatrix:
    """A (6 K, 6 K) matrix of the blocks that motions between K poses add to, the first one held.

    Which blocks there are, and in what order the poses are eliminated, is found out once.
    """

    def __init__(self, ref: IntArray, query: IntArray, count: int) -> None:
        self._place_of = _elimination_order(ref, query, count)
        ends = [self._place_of[each] for each in (ref, query)]
        held = self._place_of[:1]
        rows = np.concatenate([*(a for a in ends for _ in ends), held])
        columns = np.concatenate([*(b for _ in ends for b in ends), held])
        places, block_of = np.unique(rows * count + columns, return_inverse=True)
        shape = (len(places), len(block_of))
        ones = np.ones(len(block_of))
        self._sum = scipy.sparse.csr_array((ones, (block_of, np.arange(len(ones)))), shape=shape)
        self._factors: SuperLU | None = None
        self._columns = places % count
        self._starts = np.searchsorted(places, count * np.arange(count + 1))

    def solved(self, blocks: list[FloatArray], right: FloatArray, rest: float) -> FloatArray:
        """Return (K, 6), what the matrix takes to (K, 6) right, but for a rest of such a share.

        Its blocks are (M, 6, 6) each: from reference to itself, to query, and from that to both.
        """
        matrix = self._summed(blocks)
        in_place = np.empty_like(right)
        in_place[self._place_of] = right
        solution = self._nearly(matrix, in_place.ravel(), rest)
        if solution is None:
            self._factors = splu(matrix, permc_spec="NATURAL", **_POSITIVE)
            solution = self._factors.solve(in_place.ravel())
        return np.asarray(solution.reshape(-1, 6)[self._place_of])

    def solved_anew(self, blocks: list[FloatArray], right: FloatArray) -> FloatArray:
        """Return the same for (K, 6, D) right; what was factorised for one stays as it was."""
        in_place = np.empty_like(right)
        in_place[self._place_of] = right
        factors = splu(self._summed(blocks), permc_spec="NATURAL", **_POSITIVE)
        solution = factors.solve(in_place.reshape(6 * len(right), -1))
        return np.asarray(solution.reshape(right.shape)[self._place_of])

    def _summed(self, blocks: list[FloatArray]) -> scipy.sparse.csc_array:
        added = np.concatenate([*blocks, _ANCHOR_INFORMATION * np.eye(6)[None]]).reshape(-1, 36)
        summed = (self._sum @ added).reshape(-1, 6, 6)
        size = 6 * len(self._place_of)
        by_rows = scipy.sparse.bsr_array((summed, self._columns, self._starts), shape=(size, size))
        by_rows = by_rows.tocsr()
        # It is symmetric, so its rows are its columns.
        columns = (by_rows.data, by_rows.indices, by_rows.indptr)
        return scipy.sparse.csc_array(columns, shape=(size, size))

    def _nearly(
        self, matrix: scipy.sparse.csc_array, right: FloatArray, rest: float
    ) -> FloatArray | None:
        """Return the solution if the factors of an earlier matrix lead to it soon, else None."""
        if self._factors is None or len(right) < 6 * _WORTH_REUSING:
            return None
        factors = LinearOperator(matrix.shape, self._factors.solve, dtype=np.float64)
        solution, is_left = cg(matrix, right, rtol=rest, maxiter=_MOST_REPEATS, M=factors)
        return None if is_left else np.asarray(solution)


def _elimination_order(ref: IntArray, query: IntArray, count: int) -> IntArray:
    """Return (K,) places of the poses in an order in which eliminating them fills in little.

    It is that of minimum degree on the graph of the poses, six times smaller than their matrix.
    """
    all_poses = np.arange(count)
    rows = np.concatenate([ref, query, all_poses])
    columns = np.concatenate([query, ref, all_poses])
    degrees = np.bincount(rows, minlength=count)
    values = np.concatenate([np.full(2 * len(ref), -1.0), degrees.astype(np.float64)])
    pattern = scipy.sparse.coo_array((values, (rows, columns)), shape=(count, count)).tocsc()
    order: IntArray = splu(pattern, permc_spec="MMD_AT_PLUS_A", **_POSITIVE).perm_c
    return order.astype(np.int64)

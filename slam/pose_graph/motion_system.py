# SPDX-License-Identifier: Apache-2.0
"""The motions of a pose graph as arrays, and Gauss-Newton steps towards where they agree."""

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from slam.geometry import se3
from slam.pose_graph.graph import PoseGraph
from slam.types import FloatArray, IntArray

_ANCHOR_INFORMATION = 1e8
# Where weights hardly changed, a step is found with the factors of an earlier one, applied up to so
# many times, to this share of its right side. In a small graph new factors cost less.
_MOST_REPEATS, _REST = 30, 1e-8
_WORTH_REUSING = 500
# What is factorised is symmetric and positive definite: no row has to be exchanged for another.
_POSITIVE = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


class MotionSystem:
    """The links, steps and loops of a graph, loops last, and its normal equations.

    Attributes:
        T_start: (K, 4, 4), where the graph begins, but of a large one where its earlier solution
            has the keyframes, if it was solved; the others go on from the last one that it knew.
        is_solved: whether it was.
        first_loop: how many motions come before the loops.
    """

    def __init__(self, graph: PoseGraph) -> None:
        row_of = {k: row for row, k in enumerate(graph.T_world_kf)}
        motions = [*graph.links, *graph.steps, *graph.loops.values()]
        self.is_solved = graph.is_large and next(iter(graph.T_world_kf)) in graph.solved
        self.T_start = _start(graph) if self.is_solved else np.array([*graph.T_world_kf.values()])
        self.first_loop = len(graph.links) + len(graph.steps)
        self._ref: IntArray = np.array([row_of[each.ref_id] for each in motions])
        self._query: IntArray = np.array([row_of[each.query_id] for each in motions])
        self._T_query_ref = se3.inverse(np.array([each.motion.T_ref_query for each in motions]))
        self._information = np.array([each.motion.information for each in motions])
        self._matrix = _BlockMatrix(self._ref, self._query, len(row_of))

    def squared_errors(self, T_world_kf: FloatArray) -> FloatArray:
        """Return (L,), the squared error of every loop in units of its covariance."""
        chosen = slice(self.first_loop, None)
        errors = self._errors(T_world_kf, chosen)
        return np.asarray(np.einsum("ni,nij,nj->n", errors, self._information[chosen], errors))

    def step(self, T_world_kf: FloatArray, loop_weights: FloatArray) -> tuple[FloatArray, float]:
        """Return the (K, 4, 4) poses after a step with (L,) weights, and its largest number."""
        errors, information = self._errors(T_world_kf), self._information.copy()
        information[self.first_loop :] *= loop_weights[:, None, None]
        # log(exp(e) exp(xi)) is e + xi to first order, and more exactly with half their bracket.
        by_query = np.eye(6) + 0.5 * se3.small_adjoint(errors)
        T_query_ref = se3.inverse(T_world_kf[self._query]) @ T_world_kf[self._ref]
        by_ref = -by_query @ se3.adjoint(T_query_ref)
        gradient = np.zeros((len(T_world_kf), 6))
        blocks = []
        sides = ((self._ref, by_ref), (self._query, by_query))
        for a, J_a in sides:
            weighted = J_a.transpose(0, 2, 1) @ information
            np.add.at(gradient, a, np.einsum("nij,nj->ni", weighted, errors))
            blocks += [weighted @ J_b for _, J_b in sides]
        step = self._matrix.solved(blocks, -gradient)
        moved: FloatArray = T_world_kf @ se3.exp(step)
        return moved, float(np.abs(step).max())

    def _errors(self, T_world_kf: FloatArray, chosen: slice = slice(None)) -> FloatArray:
        ref, query = self._ref[chosen], self._query[chosen]
        T_ref_query = se3.inverse(T_world_kf[ref]) @ T_world_kf[query]
        return se3.log(self._T_query_ref[chosen] @ T_ref_query)


def _start(graph: PoseGraph) -> FloatArray:
    T_begin = np.array([*graph.T_world_kf.values()])
    is_known = np.array([k in graph.solved for k in graph.T_world_kf])
    rows = np.arange(len(T_begin))
    last = np.maximum.accumulate(np.where(is_known, rows, 0))
    T_solved = T_begin.copy()
    T_solved[is_known] = [graph.solved[k] for k in graph.T_world_kf if k in graph.solved]
    T_moved = T_begin[0] @ se3.inverse(T_solved[0]) @ T_solved[last]
    return np.asarray(T_moved @ se3.inverse(T_begin[last]) @ T_begin)


class _BlockMatrix:
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

    def solved(self, blocks: list[FloatArray], right: FloatArray) -> FloatArray:
        """Return (K, 6), what the matrix takes to (K, 6) right.

        Its blocks are (M, 6, 6) each: from reference to itself, to query, and from that to both.
        """
        added = np.concatenate([*blocks, _ANCHOR_INFORMATION * np.eye(6)[None]]).reshape(-1, 36)
        summed = (self._sum @ added).reshape(-1, 6, 6)
        size = 6 * len(right)
        parts = (summed, self._columns, self._starts)
        matrix = scipy.sparse.bsr_array(parts, shape=(size, size)).tocsc()
        in_place = np.empty_like(right)
        in_place[self._place_of] = right
        solution = self._nearly(matrix, in_place.ravel())
        if solution is None:
            self._factors = splu(matrix, permc_spec="NATURAL", **_POSITIVE)
            solution = self._factors.solve(in_place.ravel())
        return np.asarray(solution.reshape(-1, 6)[self._place_of])

    def _nearly(self, matrix: scipy.sparse.csc_array, right: FloatArray) -> FloatArray | None:
        """Return the solution if the factors of an earlier matrix lead to it soon, else None."""
        if self._factors is None or len(right) < 6 * _WORTH_REUSING:
            return None
        factors = LinearOperator(matrix.shape, self._factors.solve, dtype=np.float64)
        solution, is_left = cg(matrix, right, rtol=_REST, maxiter=_MOST_REPEATS, M=factors)
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

# SPDX-License-Identifier: Apache-2.0
"""The motions of a pose graph as arrays, and Gauss-Newton steps towards where they agree."""

import copy
from collections.abc import Iterator, Mapping

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from slam.geometry import se3
from slam.pose_graph.block_matrix import BlockMatrix
from slam.pose_graph.graph import PoseGraph
from slam.types import FloatArray, IntArray

# Links know next to nothing that have no more information than this in any direction, which is that
# of 1 rad and 1 m with some room, and next to none of what half of the links have: where those are
# of other units, or all of them poor, that is no gap. What is merely uncertain still foretells.
_NEXT_TO_NOTHING, _NEXT_TO_NONE = 2.0, 0.01
# Keyframes: with more of them an earlier solution halves the work of the next one on the way.
_MOST_FROM_NOTHING = 100
_EXACT = 1e-8  # of a step
_AT_ONCE = 1000  # loops, or pairs of them: their draws are 3 kB each
_DRAWN_AT_ONCE = 10_000  # motions
_DRAWS, _SEED = 64, 0  # enough to know a covariance of six numbers to a fifth


class MotionSystem:
    """The links, steps and loops of a graph, loops last, and its normal equations.

    Attributes:
        T_links: (K, 4, 4), where the graph begins: what the links make of it.
        T_start: (K, 4, 4), where the graph begins, but of all but a small one where its earlier
            solution has the keyframes, if it was solved; others go on from the last that it knew.
        is_solved: whether it was.
        link_count: how many motions are links, which come first.
        first_loop: how many motions come before the loops.
        loop_count: how many loops there are.
        is_planar: whether motions differ by three numbers only.
    """

    def __init__(self, graph: PoseGraph) -> None:
        row_of = {k: row for row, k in enumerate(graph.T_world_kf)}
        motions = [*graph.links, *graph.steps, *graph.loops.values()]
        first = next(iter(graph.T_world_kf))
        self.is_solved = len(graph.T_world_kf) > _MOST_FROM_NOTHING and first in graph.solved
        self.T_links = np.array([*graph.T_world_kf.values()])
        self.T_start = self.T_links
        if self.is_solved:
            self.T_start = start_from(graph.T_world_kf, graph.solved)
        self.link_count = len(graph.links)
        self.first_loop = len(graph.links) + len(graph.steps)
        self.loop_count = len(graph.loops)
        self.is_planar = graph.is_planar
        self._ref: IntArray = np.array([row_of[each.ref_id] for each in motions])
        self._query: IntArray = np.array([row_of[each.query_id] for each in motions])
        self._T_query_ref = se3.inverse(np.array([each.motion.T_ref_query for each in motions]))
        self._information = np.array([each.motion.information for each in motions])
        self._matrix = BlockMatrix(self._ref, self._query, len(row_of))

    @property
    def loop_ends(self) -> IntArray:
        """Return (L, 2) rows of the poses that loops tie, those of the reference first."""
        return np.stack([self._ref, self._query], axis=1)[self.first_loop :]

    @property
    def reaches_m(self) -> FloatArray:
        """Return (L,) how far apart loops say that their poses are."""
        return np.asarray(np.linalg.norm(self._T_query_ref[self.first_loop :, :3, 3], axis=1))

    @property
    def pieces(self) -> IntArray:
        """Return (K,) the number of the piece of every pose: links that know something join one."""
        most = np.linalg.eigvalsh(self._information[: self.first_loop])[:, -1]
        is_firm = most > min(_NEXT_TO_NOTHING, _NEXT_TO_NONE * float(np.median(most)))
        firm = (self._ref[: self.first_loop][is_firm], self._query[: self.first_loop][is_firm])
        shape = (len(self.T_links), len(self.T_links))
        joined = scipy.sparse.coo_array((np.ones(len(firm[0])), firm), shape=shape)
        return np.asarray(connected_components(joined, directed=False)[1], np.int64)

    @property
    def bridges(self) -> NDArray[np.bool_]:
        """Return (L,) which loops tie poses that only links of next to no information join."""
        ref, query = self.pieces[self.loop_ends].T
        return np.asarray(ref != query)

    def with_only(self, chosen: NDArray[np.bool_]) -> "MotionSystem":
        """Return the system of the same poses with the (L,) chosen loops alone.

        Loops of weight 0 cost as much as others: they tie together what is far apart.
        """
        rows = np.flatnonzero(np.concatenate([np.ones(self.first_loop, np.bool_), chosen]))
        part = copy.copy(self)
        part.loop_count = len(rows) - self.first_loop
        part._ref, part._query = self._ref[rows], self._query[rows]
        part._T_query_ref, part._information = self._T_query_ref[rows], self._information[rows]
        part._matrix = BlockMatrix(part._ref, part._query, len(self.T_links))
        return part

    def drifting(self, times: float) -> "MotionSystem":
        """Return the system with links and steps that are off so many times as far as they say."""
        looser = copy.copy(self)
        looser._information = self._information.copy()
        looser._information[: self.first_loop] /= times**2
        return looser

    def squared_errors(self, T_world_kf: FloatArray) -> FloatArray:
        """Return (L,), the squared error of every loop in units of its covariance."""
        chosen = slice(self.first_loop, None)
        errors = self._errors(T_world_kf, chosen)
        return np.asarray(np.einsum("ni,nij,nj->n", errors, self._information[chosen], errors))

    def links_cost(self, T_world_kf: FloatArray) -> float:
        """Return the sum of the squared errors of all that is no loop."""
        chosen = slice(0, self.first_loop)
        errors = self._errors(T_world_kf, chosen)
        return float(np.einsum("ni,nij,nj->", errors, self._information[chosen], errors))

    def step(
        self, T_world_kf: FloatArray, loop_weights: FloatArray, rest: float = _EXACT
    ) -> tuple[FloatArray, float]:
        """Return the (K, 4, 4) poses after a step with (L,) weights, and its largest number.

        Of what pulls at the poses, a rest of such a share may be left to the next step.
        """
        errors, sides = self._linearised(T_world_kf)
        information = self._information.copy()
        information[self.first_loop :] *= loop_weights[:, None, None]
        gradient = np.zeros((len(T_world_kf), 6))
        blocks = []
        for a, J_a in sides:
            weighted = J_a.transpose(0, 2, 1) @ information
            np.add.at(gradient, a, np.einsum("nij,nj->ni", weighted, errors))
            blocks += [weighted @ J_b for _, J_b in sides]
        weights = np.ones(len(information))
        weights[self.first_loop :] = loop_weights / max(loop_weights.max(initial=0.0), 1e-300)
        step = self._matrix.solved(blocks, -gradient, rest, weights)
        moved: FloatArray = T_world_kf @ se3.exp(step)
        return moved, float(np.abs(step).max())

    def left_out(
        self, T_world_kf: FloatArray, loop_weights: FloatArray
    ) -> Iterator[tuple[int, float, FloatArray]]:
        """Yield what there is without each loop that has a weight, to first order.

        That is its number, by how much the sum of squared errors falls, and the (K, 6) steps of the
        poses. The (K, 4, 4) poses solve the graph with (L,) weights, 0 or 1.
        """
        errors, sides = self._linearised(T_world_kf)
        information = self._information.copy()
        information[self.first_loop :] *= loop_weights[:, None, None]
        blocks = [
            J_a.transpose(0, 2, 1) @ information @ J_b for _, J_a in sides for _, J_b in sides
        ]
        count = len(T_world_kf)
        inverse = self._matrix.solved_anew(blocks, np.eye(6 * count).reshape(count, 6, -1))
        inverse = inverse.reshape(count, 6, count, 6)
        for loop in np.flatnonzero(loop_weights).tolist():
            n = self.first_loop + loop
            X = sum(inverse[:, :, a[n]] @ J_a[n].T for a, J_a in sides)  # (K, 6, 6)
            P = sum(J_a[n] @ X[a[n]] for a, J_a in sides)
            covariance = np.linalg.inv(self._information[n])
            # The least of the answers, where nothing else says how the two keyframes lie.
            gain = np.linalg.lstsq(covariance - P, errors[n])[0]
            yield loop, float(errors[n] @ gain), X @ gain

    def draws(self, T_world_kf: FloatArray) -> FloatArray:
        """Return (K, 6, D) tangents: how far off the poses may be, drawn from all motions.

        What two poses have in common is in the draws, too: over any detour their difference says
        how well the motions know the one between them.
        """
        _, sides = self._linearised(T_world_kf)
        information = self._shared_information()
        rng = np.random.default_rng(_SEED)
        right = np.zeros((len(T_world_kf), 6 * _DRAWS))
        for first in range(0, len(information), _DRAWN_AT_ONCE):
            some = slice(first, first + _DRAWN_AT_ONCE)
            root = np.linalg.cholesky(information[some])
            noise = root @ rng.normal(size=(len(root), 6, _DRAWS))
            for a, J_a in sides:
                ends = (a[some], np.arange(len(root)))
                shape = (len(right), len(root))
                added = scipy.sparse.csr_array((np.ones(len(root)), ends), shape=shape)
                right += added @ (J_a[some].transpose(0, 2, 1) @ noise).reshape(len(root), -1)
        blocks = [
            J_a.transpose(0, 2, 1) @ information @ J_b for _, J_a in sides for _, J_b in sides
        ]
        return self._matrix.solved_anew(blocks, right.reshape(len(right), 6, _DRAWS))

    def _shared_information(self) -> FloatArray:
        """Return (N, 6, 6): all links of a keyframe together have as much as one of them has.

        They are read off the same landmarks by the same image, and repeat its errors. Taken for
        independent, three of them would let a way of n keyframes seem 1.7 times better known than
        it is, and its drift contradict every loop that closes it. One to a keyframe stays as it is.
        """
        later = np.maximum(self._ref, self._query)[: self.link_count]
        information = self._information.copy()
        information[: self.link_count] /= np.bincount(later)[later][:, None, None]
        return information

    def predicted(self, T_world_kf: FloatArray, draws: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the (L, 6) errors of the loops and their (L, 6, 6) covariance before they count.

        It is that of the loop and that of the poses by (K, 6, D) draws.
        """
        errors, sides = self._linearised(T_world_kf, slice(self.first_loop, None))
        covariance = np.linalg.inv(self._information[self.first_loop :])
        for first in range(0, len(errors), _AT_ONCE):  # the draws of all would take gigabytes
            some = slice(first, first + _AT_ONCE)
            off = np.asarray(sum(J_a[some] @ draws[a[some]] for a, J_a in sides))
            covariance[some] += off @ off.transpose(0, 2, 1) / _DRAWS
        return errors, covariance

    def cycles(self, T_world_kf: FloatArray, draws: FloatArray, pairs: IntArray) -> FloatArray:
        """Return (P,) squared errors of the cycles through (P, 2) loops and the ways between them.

        The (K, 6, D) draws tell how well those ways are known.
        """
        parts = [pairs[first : first + _AT_ONCE] for first in range(0, len(pairs), _AT_ONCE)]
        squared = [self._cycles(T_world_kf, draws, part) for part in parts]
        return np.concatenate([np.zeros(0), *squared])

    def _cycles(self, T_world_kf: FloatArray, draws: FloatArray, pairs: IntArray) -> FloatArray:
        first, second = (pairs + self.first_loop).T
        ref, query, T_query_ref = self._ref, self._query, self._T_query_ref
        T_ends = (
            se3.inverse(T_world_kf[end[second]]) @ T_world_kf[end[first]] for end in (ref, query)
        )
        T_ref2_ref1, T_query2_query1 = T_ends
        # Against the second loop, over the first: query 2, ref 2, ref 1, query 1, query 2.
        T_cycle = T_query_ref[second] @ T_ref2_ref1 @ se3.inverse(T_query_ref[first])
        T_cycle = T_cycle @ se3.inverse(T_query2_query1)
        at_query1 = se3.adjoint(T_query2_query1)
        at_ref1 = at_query1 @ se3.adjoint(T_query_ref[first])
        at_ref2 = se3.adjoint(T_query_ref[second])
        off = at_ref1 @ draws[ref[first]] - at_ref2 @ draws[ref[second]]
        off += draws[query[second]] - at_query1 @ draws[query[first]]
        noise = np.linalg.inv(self._information[[first, second]])
        covariance = off @ off.transpose(0, 2, 1) / _DRAWS + noise[1]
        covariance += at_query1 @ noise[0] @ at_query1.transpose(0, 2, 1)
        errors = se3.log(T_cycle)
        return np.asarray((errors * np.linalg.solve(covariance, errors[..., None])[..., 0]).sum(-1))

    def _linearised(
        self, T_world_kf: FloatArray, chosen: slice = slice(None)
    ) -> tuple[FloatArray, tuple[tuple[IntArray, FloatArray], ...]]:
        """Return the errors, and by which pose, and how, references and queries change them."""
        errors = self._errors(T_world_kf, chosen)
        ref, query = self._ref[chosen], self._query[chosen]
        # log(exp(e) exp(xi)) is e + xi to first order, and more exactly with half their bracket.
        by_query = np.eye(6) + 0.5 * se3.small_adjoint(errors)
        T_query_ref = se3.inverse(T_world_kf[query]) @ T_world_kf[ref]
        return errors, ((ref, -by_query @ se3.adjoint(T_query_ref)), (query, by_query))

    def _errors(self, T_world_kf: FloatArray, chosen: slice = slice(None)) -> FloatArray:
        ref, query = self._ref[chosen], self._query[chosen]
        T_ref_query = se3.inverse(T_world_kf[ref]) @ T_world_kf[query]
        return se3.log(self._T_query_ref[chosen] @ T_ref_query)


def start_from(T_begin: Mapping[int, FloatArray], solved: Mapping[int, FloatArray]) -> FloatArray:
    """Return (K, 4, 4): where an earlier solution has keyframes; others go on from the last there.

    Both have (4, 4) by keyframe id, the first one among the solved, which stays where it begins.
    """
    T_beginning = np.array([*T_begin.values()])
    is_known = np.array([k in solved for k in T_begin])
    last = np.maximum.accumulate(np.where(is_known, np.arange(len(is_known)), 0))
    T_solved = T_beginning.copy()
    T_solved[is_known] = [solved[k] for k in T_begin if k in solved]
    T_moved = T_beginning[0] @ se3.inverse(T_solved[0]) @ T_solved[last]
    return np.asarray(T_moved @ se3.inverse(T_beginning[last]) @ T_beginning)

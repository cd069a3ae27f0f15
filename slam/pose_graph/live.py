# SPDX-License-Identifier: Apache-2.0
"""The same graph solved beside a camera that is being tracked.

GTSAM keeps Python's global lock for as long as it optimises, and no other thread can track a frame
meanwhile. So the corrections on the way are found here: graduated non-convexity with the cost that
`solve` minimises, by Gauss-Newton steps on arrays. `solve` has the last word.
"""

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import splu
from scipy.special import gammaincinv

from slam.geometry import se3
from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.types import FloatArray, IntArray

_CONVEXITY_STEP = 1.4  # by how much the cost comes nearer to the true one in a round
_MOST_ROUNDS = 60
_POLISH_STEPS = 3  # once it is clear which loops hold
_ANCHOR_INFORMATION = 1e8


def solve_beside(graph: PoseGraph, inlier_probability: float) -> GraphSolution:
    """Return about what `solve` would, without its warnings, and let other threads run."""
    if not graph.loops and not graph.steps:
        return GraphSolution(dict(graph.T_world_kf), {})
    system = _System(graph)
    # The quantile of chi-squared with six degrees of freedom; scipy.stats takes long to load.
    limit = 2.0 * float(gammaincinv(3.0, inlier_probability))
    T, first = system.T_start, len(graph.links) + len(graph.steps)
    squared = system.squared_errors(T)[first:]
    # Convex at first, where no loop has a say beyond its limit; then step by step what it should be
    # (Yang et al. 2020, truncated least squares).
    convexity = 1.0 / max(2.0 * float(squared.max(initial=0.0)) / limit - 1.0, 1e-6)
    for _ in range(_MOST_ROUNDS):
        weights = _weights(squared, limit, convexity)
        T = system.step(T, weights)
        squared = system.squared_errors(T)[first:]
        if ((weights < 1e-3) | (weights > 1.0 - 1e-3)).all():
            break
        convexity *= _CONVEXITY_STEP
    for _ in range(_POLISH_STEPS):
        weights = np.where(squared < limit, 1.0, 0.0)
        T = system.step(T, weights)
        squared = system.squared_errors(T)[first:]
    return GraphSolution(
        dict(zip(graph.T_world_kf, T, strict=True)),
        dict(zip(graph.loops, np.where(squared < limit, 1.0, 0.0).tolist(), strict=True)),
    )


def _weights(squared: FloatArray, limit: float, convexity: float) -> FloatArray:
    """Return (L,) weights of loops, 0 to 1, by their squared errors: eq. 14 of the paper."""
    between = np.sqrt(limit * convexity * (convexity + 1.0) / np.maximum(squared, 1e-12))
    return np.clip(between - convexity, 0.0, 1.0)


class _System:
    """The motions of a graph as arrays, loops last, and its normal equations."""

    def __init__(self, graph: PoseGraph) -> None:
        row_of = {k: row for row, k in enumerate(graph.T_world_kf)}
        motions = [*graph.links, *graph.steps, *graph.loops.values()]
        self.T_start = np.array(list(graph.T_world_kf.values()))
        self._ref: IntArray = np.array([row_of[each.ref_id] for each in motions])
        self._query: IntArray = np.array([row_of[each.query_id] for each in motions])
        self._T_query_ref = se3.inverse(np.array([each.motion.T_ref_query for each in motions]))
        self._information = np.array([each.motion.information for each in motions])

    def squared_errors(self, T_world_kf: FloatArray) -> FloatArray:
        """Return (M,), the squared error of every motion in units of its covariance."""
        errors = self._errors(T_world_kf)
        return np.asarray(np.einsum("ni,nij,nj->n", errors, self._information, errors))

    def step(self, T_world_kf: FloatArray, loop_weights: FloatArray) -> FloatArray:
        """Return the (K, 4, 4) poses after a Gauss-Newton step with these (L,) weights."""
        count, errors = len(T_world_kf), self._errors(T_world_kf)
        information = self._information.copy()
        information[len(information) - len(loop_weights) :] *= loop_weights[:, None, None]
        # log(exp(e) exp(xi)) is e + xi to first order, and more exactly with half their bracket.
        by_query = np.eye(6) + 0.5 * se3.small_adjoint(errors)
        T_query_ref = se3.inverse(T_world_kf[self._query]) @ T_world_kf[self._ref]
        by_ref = -by_query @ se3.adjoint(T_query_ref)
        rows: list[IntArray] = []
        columns: list[IntArray] = []
        blocks: list[FloatArray] = []
        gradient = np.zeros((count, 6))
        sides = ((self._ref, by_ref), (self._query, by_query))
        for a, J_a in sides:
            weighted = J_a.transpose(0, 2, 1) @ information
            np.add.at(gradient, a, np.einsum("nij,nj->ni", weighted, errors))
            for b, J_b in sides:
                rows.append(a)
                columns.append(b)
                blocks.append(weighted @ J_b)
        hessian = _block_matrix(np.concatenate(rows), np.concatenate(columns), blocks, count)
        step = splu(hessian).solve(-gradient.ravel()).reshape(-1, 6)
        moved: FloatArray = T_world_kf @ se3.exp(step)
        return moved

    def _errors(self, T_world_kf: FloatArray) -> FloatArray:
        T_ref_query = se3.inverse(T_world_kf[self._ref]) @ T_world_kf[self._query]
        return se3.log(self._T_query_ref @ T_ref_query)


def _block_matrix(
    rows: IntArray, columns: IntArray, blocks: list[FloatArray], count: int
) -> scipy.sparse.csc_array:
    """Return the (6 K, 6 K) sum of (6, 6) blocks, with the first pose held where it is."""
    values = np.concatenate([*blocks, _ANCHOR_INFORMATION * np.eye(6)[None]])
    rows, columns = np.append(rows, 0), np.append(columns, 0)
    inner = np.arange(6)
    i = np.broadcast_to(6 * rows[:, None, None] + inner[:, None], values.shape)
    j = np.broadcast_to(6 * columns[:, None, None] + inner, values.shape)
    entries = (values.ravel(), (i.ravel(), j.ravel()))
    return scipy.sparse.coo_array(entries, shape=(6 * count, 6 * count)).tocsc()

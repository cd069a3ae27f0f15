# SPDX-License-Identifier: Apache-2.0
"""Tests of the matrix of a pose graph's normal equations."""

import numpy as np
import pytest
from scipy.sparse.linalg import splu

from slam.pose_graph import block_matrix
from slam.pose_graph.block_matrix import BlockMatrix
from slam.types import FloatArray, IntArray

ANCHOR = 1e8
EXACT = 1e-12


class Problem:
    """A chain of poses and random loops of certain weights, as blocks and as one dense matrix."""

    def __init__(self, count: int, weights: FloatArray) -> None:
        rng = np.random.default_rng(0)
        chain = np.arange(count - 1)
        loops = np.zeros((len(weights), 2), np.int64)
        for loop in loops:
            loop[:] = rng.choice(count, 2, replace=False)
        self.ref: IntArray = np.concatenate([chain, loops[:, 0]])
        self.query: IntArray = np.concatenate([chain + 1, loops[:, 1]])
        self.weights = np.concatenate([np.ones(len(chain)), weights])
        off = 0.1 * rng.normal(size=(len(self.ref), 6, 6))
        sides = [off - np.eye(6), np.tile(np.eye(6), (len(off), 1, 1))]
        weight = self.weights[:, None, None]
        self.blocks = [weight * (a.transpose(0, 2, 1) @ b) for a in sides for b in sides]
        self.right = rng.normal(size=(count, 6))
        dense = np.zeros((count, 6, count, 6))
        ends = (self.ref, self.query)
        pairs = [(a, b) for a in ends for b in ends]
        for (a, b), block in zip(pairs, self.blocks, strict=True):
            np.add.at(dense.transpose(0, 2, 1, 3), (a, b), block)
        dense[0, :, 0] += ANCHOR * np.eye(6)
        self.expected = np.linalg.solve(dense.reshape(6 * count, -1), self.right.ravel())

    def matrix(self) -> BlockMatrix:
        return BlockMatrix(self.ref, self.query, len(self.right))

    def solved(self, rest: float, matrix: BlockMatrix | None = None) -> FloatArray:
        matrix = matrix or self.matrix()
        return matrix.solved(self.blocks, self.right, rest, self.weights).ravel()


@pytest.fixture
def fills(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return how much every factor of a matrix of poses that is made from now on holds."""
    found: list[int] = []

    def noted(matrix: object, permc_spec: str, **how: object) -> object:
        factors = splu(matrix, permc_spec=permc_spec, **how)
        if permc_spec == "NATURAL":
            found.append(factors.nnz)
        return factors

    monkeypatch.setattr(block_matrix, "splu", noted)
    return found


@pytest.mark.parametrize("count", [8, 520])
@pytest.mark.parametrize("least", [0.0, 0.04, 0.5, 1.0])
def test_a_solution_is_that_of_the_whole_matrix(count: int, least: float) -> None:
    problem = Problem(count, np.random.default_rng(1).uniform(least, 1.0, count // 4))
    np.testing.assert_allclose(problem.solved(EXACT), problem.expected, rtol=1e-6, atol=1e-10)


def test_many_right_sides_are_solved_at_once() -> None:
    problem = Problem(12, np.ones(4))
    right = np.stack([problem.right, 2.0 * problem.right], axis=-1)
    found = problem.matrix().solved_anew(problem.blocks, right)
    expected = problem.expected.reshape(-1, 6)
    np.testing.assert_allclose(found, np.stack([expected, 2.0 * expected], axis=-1), rtol=1e-9)


def test_motions_of_no_weight_are_not_in_the_factors(fills: list[int]) -> None:
    without, with_idle = Problem(40, np.zeros(0)), Problem(40, np.zeros(100))
    for each in (without, with_idle):
        each.matrix().solved_anew(each.blocks, each.right[..., None])
    assert fills[0] == fills[1]


def test_motions_of_little_weight_are_left_to_repeats_in_a_large_graph(fills: list[int]) -> None:
    problem = Problem(520, np.full(500, 1e-4))
    matrix = problem.matrix()
    found = problem.solved(EXACT, matrix)
    np.testing.assert_allclose(found, problem.expected, rtol=1e-6, atol=1e-10)
    matrix.solved_anew(problem.blocks, problem.right[..., None])
    assert len(fills) == 2, "repeats did not lead there"
    assert fills[0] < 0.2 * fills[1]


def test_of_many_motions_the_fewer_are_taken_in_the_thicker_factors_would_be(
    fills: list[int],
) -> None:
    problem = Problem(520, np.random.default_rng(1).uniform(0.05, 1.0, 600))
    matrix = problem.matrix()
    found = problem.solved(EXACT, matrix)
    np.testing.assert_allclose(found, problem.expected, rtol=1e-6, atol=1e-10)
    matrix.solved_anew(problem.blocks, problem.right[..., None])
    assert len(fills) == 2, "repeats did not lead there"
    thin = 2 * 36 * block_matrix._THIN * 520  # numbers of both factors
    assert fills[0] < thin < fills[1]


def test_factors_are_used_again_while_weights_hardly_change(fills: list[int]) -> None:
    problem = Problem(520, np.ones(50))
    matrix = problem.matrix()
    problem.solved(1e-8, matrix)
    problem.blocks = [1.001 * each for each in problem.blocks]
    problem.solved(1e-8, matrix)
    assert len(fills) == 1


def test_where_repeats_lead_nowhere_all_motions_are_taken_in(
    fills: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_matrix, "_MOST_REPEATS", 1)
    problem = Problem(520, np.full(200, 0.01))
    np.testing.assert_allclose(problem.solved(EXACT), problem.expected, rtol=1e-6, atol=1e-10)
    assert len(fills) == 2

# SPDX-License-Identifier: Apache-2.0
"""Words for binary descriptors, found by descending a tree (Galvez-Lopez 2012, Nister 2006)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Descriptors = NDArray[np.uint8]

ROUNDS = 8
CHUNK = 65536


@dataclass(frozen=True)
class VocabularyTree:
    """A tree whose every node has as many children; its leaves are the words.

    Attributes:
        levels: per level (nodes, children, B) uint8, the descriptors in the middle of each child;
            the children of child c of node n are those of node n * children + c one level below.
    """

    levels: tuple[Descriptors, ...]

    @property
    def words(self) -> int:
        """How many words there are."""
        return int(np.prod(self.levels[-1].shape[:2]))

    def __call__(self, descriptors: Descriptors) -> NDArray[np.int64]:
        """Return the (N,) words of (N, B) descriptors; of equally near children the first."""
        nodes = np.zeros(len(descriptors), np.int64)
        for level in self.levels:
            children = level.shape[1]
            for start in range(0, len(nodes), CHUNK):
                part = slice(start, start + CHUNK)
                distances = _hamming(descriptors[part, None], level[nodes[part]])
                nodes[part] = nodes[part] * children + distances.argmin(axis=1)
        return nodes


def grow(
    descriptors: Descriptors, children: int, depth: int, rng: np.random.Generator
) -> VocabularyTree:
    """Return a tree of children ** depth words of (N, B) descriptors, N > 0.

    Each node's descriptors are divided among its children by k-means++ under the Hamming
    distance: a middle has the bits that most of its descriptors have.
    """
    owners = np.zeros(len(descriptors), np.int64)
    levels = []
    for depth_so_far in range(depth):
        nodes = children**depth_so_far
        level = np.zeros((nodes, children, descriptors.shape[1]), np.uint8)
        order = np.argsort(owners, kind="stable")
        bounds = np.searchsorted(owners[order], np.arange(nodes + 1))
        for node in range(nodes):
            own = order[bounds[node] : bounds[node + 1]]
            if len(own):
                level[node], nearest = _k_majority(descriptors[own], children, rng)
                owners[own] = owners[own] * children + nearest
        levels.append(level)
    return VocabularyTree(tuple(levels))


def _k_majority(
    descriptors: Descriptors, count: int, rng: np.random.Generator
) -> tuple[Descriptors, NDArray[np.int64]]:
    """Return (count, B) middles, some of them equal where there is little to divide, and (N,)."""
    middles = _scattered(descriptors, count, rng)
    nearest = _nearest(descriptors, middles)
    bits = np.unpackbits(descriptors, axis=1)
    for _ in range(ROUNDS):
        for k in np.unique(nearest):
            middles[k] = np.packbits(2 * bits[nearest == k].mean(axis=0) > 1.0)
        before, nearest = nearest, _nearest(descriptors, middles)
        if np.array_equal(before, nearest):
            break
    return middles, nearest


def _scattered(descriptors: Descriptors, count: int, rng: np.random.Generator) -> Descriptors:
    """Return (count, B) descriptors, each drawn by its squared distance to those before it."""
    chosen = [int(rng.integers(len(descriptors)))]
    distances = _hamming(descriptors, descriptors[chosen])
    while len(chosen) < count:
        chances = np.cumsum(distances**2)
        drawn = np.searchsorted(chances, rng.random() * chances[-1], side="right")
        chosen.append(min(int(drawn), len(descriptors) - 1))
        distances = np.minimum(distances, _hamming(descriptors, descriptors[chosen[-1:]]))
    return descriptors[chosen]


def _nearest(descriptors: Descriptors, middles: Descriptors) -> NDArray[np.int64]:
    parts: Sequence[NDArray[np.int64]] = [
        _hamming(descriptors[start : start + CHUNK, None], middles).argmin(axis=1)
        for start in range(0, len(descriptors), CHUNK)
    ]
    return np.concatenate(parts)


def _hamming(a: Descriptors, b: Descriptors) -> NDArray[np.int64]:
    """Return the number of different bits, over the last axis, of descriptors of 8 n bytes."""
    wide = (np.ascontiguousarray(side).view(np.uint64) for side in (a, b))
    distances: NDArray[np.int64] = np.bitwise_count(np.bitwise_xor(*wide)).sum(axis=-1, dtype=int)
    return distances

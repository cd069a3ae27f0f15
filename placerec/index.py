# SPDX-License-Identifier: Apache-2.0
"""The places seen so far and how similar they are to a new one; features that match."""

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import COSINES, Comparer, Embeddings, Similarities
from placerec.errors import RecognizerError

_FIRST_CAPACITY = 64
"""Places that the array of embeddings can hold at first; it doubles when it is full."""


class PlaceIndex:
    """The embeddings of the places seen so far, compared exhaustively.

    Comparing with 10,000 places takes milliseconds: a map needs no search structure, and an exact
    answer is the same on every run.
    """

    def __init__(self, comparer: Comparer = COSINES) -> None:
        """Make an empty index whose embeddings are compared as a (checked) recognizer does it."""
        self._comparer = comparer
        self._rows: Embeddings | None = None
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, embedding: Embeddings) -> int:
        """Remember a float32 embedding and return its id: 0, 1, 2, ...

        Raises:
            RecognizerError: it has another shape than the ones before.
        """
        if self._rows is None:
            if embedding.ndim == 0 or embedding.size == 0:
                raise RecognizerError(f"an embedding has shape {embedding.shape}, not (D,)")
            self._rows = np.zeros((_FIRST_CAPACITY, *embedding.shape), np.float32)
        self._check_shape(embedding, self._rows)
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = embedding
        self._count += 1
        return self._count - 1

    def query(
        self, embedding: Embeddings, count: int, limit: int | None = None
    ) -> tuple[NDArray[np.int64], Similarities]:
        """Return the places most similar to an embedding that was seen after them, best first.

        Args:
            embedding: of the shape of the remembered ones.
            count: how many places are wanted.
            limit: only ids below this are looked at; default: all.

        Returns:
            (M,) int64 ids and (M,) float32 similarities, M <= count; equal ones by lower id first.

        Raises:
            RecognizerError: the embedding has another shape than the remembered ones, or comparing
                failed.
        """
        stop = self._count if limit is None else max(0, min(limit, self._count))
        if self._rows is None or stop == 0:
            return np.empty(0, np.int64), np.empty(0, np.float32)
        self._check_shape(embedding, self._rows)
        past = self._rows[max(0, self._count - self._comparer.looks_back) : self._count]
        queries = np.concatenate([past, embedding[None]])
        similarities = self._comparer.compare(queries, self._rows[:stop])[-1]
        ids = np.argsort(-similarities, kind="stable")[: max(0, count)]
        return ids, similarities[ids]

    def similarities(self) -> Similarities:
        """Return the (K, K) float32 similarities between all remembered places.

        Raises:
            RecognizerError: comparing failed.
        """
        if self._rows is None:
            return np.empty((0, 0), np.float32)
        rows = self._rows[: self._count]
        return self._comparer.compare(rows, rows)

    @staticmethod
    def _check_shape(embedding: Embeddings, rows: Embeddings) -> None:
        if embedding.shape != rows.shape[1:]:
            raise RecognizerError(
                f"an embedding has shape {embedding.shape}; the places before have {rows.shape[1:]}"
            )


def mutual_matches(
    ours: NDArray[np.uint8], theirs: NDArray[np.uint8], max_distance: int = 64
) -> NDArray[np.int64]:
    """Return (M, 2) index pairs of (N, B) and (K, B) uint8 descriptors, each the other's nearest.

    Of equally near ones the first is taken; none is further away by Hamming than max_distance.
    """
    if not (len(ours) and len(theirs)):
        return np.zeros((0, 2), np.int64)
    a, b = (np.unpackbits(each, axis=1).astype(np.float32) for each in (ours, theirs))
    # Small whole numbers, which float32 adds up exactly, whatever the order.
    distance = a.sum(axis=1)[:, None] - (2.0 * a - 1.0) @ b.T
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(a))
    is_mutual = distance.argmin(axis=0)[nearest] == rows
    chosen = is_mutual & (distance[rows, nearest] <= max_distance)
    return np.stack([rows[chosen], nearest[chosen]], axis=1)

# SPDX-License-Identifier: Apache-2.0
"""The places seen so far and how similar they are to a new one."""

import numpy as np
from numpy.typing import NDArray

from placerec.recognizer import RecognizerError

BLOCK = 64


class PlaceIndex:
    """The embeddings of the places seen so far, compared exhaustively.

    One matrix-vector product over 10,000 places takes milliseconds: a map needs no search
    structure, and an exact answer is the same on every run.
    """

    def __init__(self) -> None:
        self._rows: NDArray[np.float32] | None = None
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, embedding: NDArray[np.float32]) -> int:
        """Remember a (D,) float32 unit-length embedding and return its id: 0, 1, 2, ...

        Raises:
            RecognizerError: it has another size than the ones before.
        """
        rows = self._with_room_for(embedding)
        rows[self._count] = embedding
        self._count += 1
        return self._count - 1

    def query(
        self, embedding: NDArray[np.float32], count: int, limit: int | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the places most similar to a (D,) embedding, best first.

        Args:
            embedding: (D,) float32, unit length.
            count: how many places are wanted.
            limit: only ids below this are looked at; default: all.

        Returns:
            (M,) int64 ids and (M,) float32 cosines, M <= count; equal ones by lower id first.

        Raises:
            RecognizerError: the embedding has another size than the remembered ones.
        """
        stop = self._count if limit is None else max(0, min(limit, self._count))
        if self._rows is None or stop == 0:
            return np.empty(0, np.int64), np.empty(0, np.float32)
        self._check_size(embedding, self._rows)
        # Whole blocks of rows: BLAS adds up a remainder in another order, and two equal places
        # would differ in the last bit instead of tying.
        blocks = self._rows[: -(-stop // BLOCK) * BLOCK]
        similarities = np.clip(blocks @ embedding, -1.0, 1.0)[:stop]
        ids = np.argsort(-similarities, kind="stable")[: max(0, count)]
        return ids, similarities[ids]

    def similarities(self) -> NDArray[np.float32]:
        """Return the (K, K) float32 cosines between all remembered places."""
        if self._rows is None:
            return np.empty((0, 0), np.float32)
        rows = self._rows[: self._count]
        similarities: NDArray[np.float32] = np.clip(rows @ rows.T, -1.0, 1.0)
        return similarities

    def _with_room_for(self, embedding: NDArray[np.float32]) -> NDArray[np.float32]:
        if self._rows is None:
            if embedding.ndim != 1 or embedding.size == 0:
                raise RecognizerError(f"an embedding has shape {embedding.shape}, not (D,)")
            self._rows = np.zeros((BLOCK, embedding.size), np.float32)
        self._check_size(embedding, self._rows)
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        return self._rows

    @staticmethod
    def _check_size(embedding: NDArray[np.float32], rows: NDArray[np.float32]) -> None:
        if embedding.shape != rows.shape[1:]:
            raise RecognizerError(
                f"an embedding has shape {embedding.shape}; the places before have {rows.shape[1:]}"
            )

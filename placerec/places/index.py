# SPDX-License-Identifier: Apache-2.0
"""The places seen so far and how similar they are to a new one."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import COSINES, Comparer, Embeddings, Similarities
from placerec.errors import RecognizerError

FloatArray = NDArray[np.float64]

_BLOCK_BYTES = 2**25
"""Codes are kept in blocks that stay where they are, so that no place waits for a copy.

Memory is only taken as it fills; blocks of so many bytes are of large pages where there are any.
"""
_MOST_LEVELS = 127  # a value and its sign in a byte
_ANSWERED_AT_ONCE = 160_000
"""Similarities that a recognizer with its own `compare` is asked for at a time, in the end."""


class PlaceIndex:
    """The embeddings of the places seen so far; the answers are those of comparing them all.

    They are the same on every run, for no place is left out that could matter: cosines are bounded
    first, from a byte per value, and then only those that may be among the best are computed.
    """

    def __init__(self, comparer: Comparer = COSINES) -> None:
        """Make an empty index whose embeddings are compared as a (checked) recognizer does it."""
        self._comparer = comparer
        self._rows: list[Embeddings] = []
        self._bounds = _CosineBounds() if comparer is COSINES else None

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, embedding: Embeddings) -> int:
        """Remember a float32 embedding and return its id: 0, 1, 2, ...

        Raises:
            RecognizerError: it has another shape than the ones before.
        """
        if embedding.ndim == 0 or embedding.size == 0:
            raise RecognizerError(f"an embedding has shape {embedding.shape}, not (D,)")
        self._check_shape(embedding)
        self._rows.append(np.array(embedding, np.float32))
        if self._bounds is not None:
            self._bounds.add(embedding)
        return len(self._rows) - 1

    def select(self, ids: NDArray[np.int64]) -> "PlaceIndex":
        """Return an index of these places alone, in their order."""
        chosen = type(self)(self._comparer)
        for k in ids:
            chosen.add(self._rows[k])
        return chosen

    def query(
        self, embedding: Embeddings, count: int, among: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.int64], Similarities]:
        """Return the places most similar to an embedding that was seen after them, best first.

        Args:
            embedding: of the shape of the remembered ones.
            count: how many places are wanted.
            among: (K,), which places are looked at; default: all.

        Returns:
            (M,) int64 ids and (M,) float32 similarities, M <= count; equal ones by lower id first.

        Raises:
            RecognizerError: the embedding has another shape than the remembered ones, or comparing
                failed.
        """
        ids = np.arange(len(self._rows)) if among is None else np.flatnonzero(among)
        if ids.size == 0 or count <= 0:
            return np.empty(0, np.int64), np.empty(0, np.float32)
        self._check_shape(embedding)
        if self._bounds is not None:
            ids = self._worth_comparing(embedding, count, ids, self._bounds)
            similarities = self._cosines(embedding, ids)
        else:
            past = self._rows[max(0, len(self._rows) - self._comparer.looks_back) :]
            queries, references = np.stack([*past, embedding]), np.stack(self._rows[: ids[-1] + 1])
            similarities = self._comparer.compare(queries, references)[-1, ids]
        best = np.argsort(-similarities, kind="stable")[:count]
        return ids[best], similarities[best]

    def similarities(self, step: int = 1) -> Similarities:
        """Return the (N, N) float32 similarities between every step-th remembered place.

        Raises:
            RecognizerError: comparing failed.
        """
        if not self._rows:
            return np.empty((0, 0), np.float32)
        if self._bounds is not None:
            shown = np.stack(self._rows[::step])
            return self._comparer.compare(shown, shown)
        rows = np.stack(self._rows)
        length = step * max(1, _ANSWERED_AT_ONCE // (step * len(rows)))
        parts = []
        for first in range(0, len(rows), length):
            start = max(0, first - self._comparer.looks_back)
            last = range(first, min(first + length, len(rows)), step)[-1]
            answer = self._comparer.compare(rows[start : last + 1], rows)
            parts.append(answer[first - start :: step, ::step])
        return np.concatenate(parts)

    def _worth_comparing(
        self,
        embedding: Embeddings,
        count: int,
        ids: NDArray[np.int64],
        bounds: "_CosineBounds",
    ) -> NDArray[np.int64]:
        """Return those of the ids that may be among the count most similar, ties included."""
        if count >= len(ids):
            return ids
        estimates, margins = (values[ids] for values in bounds.of(embedding))
        likely = ids[np.argpartition(estimates, -count)[-count:]]
        least = self._cosines(embedding, likely).min()
        # Cosines end at -1, and so may their bounds.
        return np.asarray(ids[np.maximum(estimates + margins, -1.0) >= least])

    def _cosines(self, embedding: Embeddings, ids: NDArray[np.int64]) -> Similarities:
        rows = np.stack([self._rows[k] for k in ids])
        return np.asarray(self._comparer.compare(embedding[None], rows)[0])

    def _check_shape(self, embedding: Embeddings) -> None:
        if self._rows and embedding.shape != self._rows[0].shape:
            raise RecognizerError(
                f"an embedding has shape {embedding.shape}; "
                f"the places before have {self._rows[0].shape}"
            )


@dataclass(frozen=True)
class _Coded:
    """A vector x and its rounded r = scale * (code - levels).

    Attributes:
        code: (D,) uint8.
        scale: how much a level is.
        square: of the length of code - levels.
        length, error: those of r and of x - r.
    """

    code: NDArray[np.uint8]
    scale: float
    square: float
    length: float
    error: float


class _CosineBounds:
    """Bounds of the cosines with any number of vectors, from a byte for each of their values.

    Memory is what a search waits for: four times less of it is read than by comparing exactly.
    """

    def __init__(self) -> None:
        self._codes: list[NDArray[np.uint8]] = []
        self._numbers: list[FloatArray] = []
        self._count = 0

    def add(self, vector: Embeddings) -> None:
        """Remember a (D,) vector."""
        size = max(1, _BLOCK_BYTES // vector.size)
        one, at = _coded(vector), self._count % size
        if at == 0:
            self._codes.append(np.empty((size, vector.size), np.uint8))
            self._numbers.append(np.empty((4, size)))
        self._codes[-1][at] = one.code
        self._numbers[-1][:, at] = one.scale, 0.5 * one.scale * one.square, one.length, one.error
        self._count += 1

    def of(self, vector: Embeddings) -> tuple[FloatArray, FloatArray]:
        """Return (K,) estimates of the float32 products with all vectors, and their errors at most.

        With x = r + e and r the rounded vector, x . y = r_x . r_y + r_x . e_y + e_x . y; the last
        two are bounded by the lengths of their factors (Cauchy and Schwarz).
        """
        one = _coded(vector)
        # Adding D products up in float32, in any order, is wrong by D half units of its precision.
        slack = vector.size * float(np.finfo(np.float32).eps) * (one.length + one.error)
        weights = np.array([one.error + slack, one.length + one.error + slack])
        found, start = np.empty((2, self._count)), 0
        for codes, numbers in zip(self._codes, self._numbers, strict=True):
            estimates, margins = found[:, start : start + len(codes)]
            scales, halves = numbers[:2, : estimates.size]
            # Between whole numbers a distance is exact, on any machine.
            distances, _ = cv2.batchDistance(
                codes[: estimates.size], one.code[None], cv2.CV_32S, normType=cv2.NORM_L2SQR, K=1
            )
            np.multiply(one.square - distances[:, 0], 0.5 * one.scale * scales, out=estimates)
            estimates += one.scale * halves
            np.matmul(weights, numbers[2:, : estimates.size], out=margins)
            start += len(codes)
        return found[0], found[1]


def _coded(vector: Embeddings) -> _Coded:
    exact = vector.astype(np.float64)
    # Fewer levels where vectors are so long that a squared distance would leave 32 bits.
    levels = min(_MOST_LEVELS, math.isqrt(2**29 // vector.size))
    scale = float(np.abs(exact).max()) / levels or 1.0
    whole = np.rint(exact / scale)
    length, error = (float(np.linalg.norm(each)) for each in (scale * whole, exact - scale * whole))
    return _Coded((whole + levels).astype(np.uint8), scale, float(whole @ whole), length, error)

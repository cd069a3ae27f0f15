# SPDX-License-Identifier: Apache-2.0
"""The places seen so far and how similar they are to a new one."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import COSINES, Comparer, Embeddings, Similarities
from placerec.compiled import compiled
from placerec.errors import RecognizerError

FloatArray = NDArray[np.float64]

_BLOCK_BYTES = 2**21
"""Codes are kept in blocks that stay where they are, so that no place waits for a copy.

Memory is only taken as it fills, and a small page at a time: of larger blocks, numpy asks for large
pages, and the place that is the first on one waits until all of its 2 MB are cleared.
"""
_BLOCKS_OF_A_THREAD = 8
"""Comparing so many takes a millisecond, ten times as long as starting a thread for them."""
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
        estimates, highest = bounds.of(embedding)
        if len(ids) < len(estimates):
            estimates, highest = estimates[ids], highest[ids]
        likely = ids[np.argpartition(estimates, -count)[-count:]]
        least = self._cosines(embedding, likely).min()
        return np.asarray(ids[highest >= least])

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
    """A vector x and its rounded r = scale * code.

    Attributes:
        code: (D,) int8.
        scale: how much a level is.
        length, error: those of r and of x - r.
    """

    code: NDArray[np.int8]
    scale: float
    length: float
    error: float


class _CosineBounds:
    """Bounds of the cosines with any number of vectors, from a byte for each of their values.

    Memory is what a search waits for: four times less of it is read than by comparing exactly.
    """

    def __init__(self) -> None:
        self._codes: list[NDArray[np.int8]] = []
        self._numbers: list[FloatArray] = []
        self._count = 0

    def add(self, vector: Embeddings) -> None:
        """Remember a (D,) vector."""
        size = max(1, _BLOCK_BYTES // vector.size)
        one, at = _coded(vector), self._count % size
        if at == 0:
            self._codes.append(np.empty((size, vector.size), np.int8))
            self._numbers.append(np.empty((size, 3)))
        self._codes[-1][at] = one.code
        self._numbers[-1][at] = one.scale, one.length, one.error
        self._count += 1

    def of(self, vector: Embeddings) -> tuple[FloatArray, FloatArray]:
        """Return (K,) estimates of the float32 cosines with all vectors, and what they are at most.

        With x = r + e and r the rounded vector, x . y = r_x . r_y + r_x . e_y + e_x . y; the last
        two are bounded by the lengths of their factors (Cauchy and Schwarz).
        """
        one = _coded(vector)
        # Adding D products up in float32, in any order, is wrong by D half units of its precision.
        slack = vector.size * float(np.finfo(np.float32).eps) * (one.length + one.error)
        weights = np.array([one.scale, one.error + slack, one.length + one.error + slack])
        code = one.code.astype(np.int16)  # or each comparison would widen it anew
        estimates, highest = np.empty(self._count), np.empty(self._count)
        threads = max(1, min(os.cpu_count() or 1, len(self._codes) // _BLOCKS_OF_A_THREAD))

        def bound(first: int) -> None:
            for number in range(first, len(self._codes), threads):
                codes, numbers = self._codes[number], self._numbers[number]
                rows = slice(number * len(codes), (number + 1) * len(codes))
                _write_bounds(codes, numbers, code, weights, estimates[rows], highest[rows])

        if threads == 1:
            bound(0)
        else:
            with ThreadPoolExecutor(threads, thread_name_prefix="places") as pool:
                list(pool.map(bound, range(threads)))  # raises what stopped one of them
        return estimates, highest


@compiled
def _write_bounds(
    codes: NDArray[np.int8],
    numbers: FloatArray,
    code: NDArray[np.int16],
    weights: FloatArray,
    estimates: FloatArray,
    highest: FloatArray,
) -> None:
    """Write the estimates of K cosines, and what they are at most.

    Args:
        codes: (K or more, D), of the vectors.
        numbers: (K or more, 3), their scales, lengths and errors.
        code: (D,), of the one that they are compared with.
        weights: (3,), what it makes of those numbers.
        estimates: (K,), written to.
        highest: (K,), written to.
    """
    scale, per_length, per_error = weights
    for k in range(len(estimates)):
        product = 0
        for i in range(len(code)):
            product += codes[k, i] * code[i]
        # In 32 bits, which hold it, more are added up at a time.
        estimates[k] = scale * numbers[k, 0] * np.int32(product)
        margin = per_length * numbers[k, 1] + per_error * numbers[k, 2]
        highest[k] = max(estimates[k] + margin, -1.0)  # where cosines end


def _coded(vector: Embeddings) -> _Coded:
    exact = vector.astype(np.float64)
    # Fewer levels where vectors are so long that a product would leave 32 bits.
    levels = min(_MOST_LEVELS, math.isqrt((2**31 - 1) // vector.size))
    scale = float(np.abs(exact).max()) / levels or 1.0
    whole = np.rint(exact / scale)
    length, error = (float(np.linalg.norm(each)) for each in (scale * whole, exact - scale * whole))
    return _Coded(whole.astype(np.int8), scale, length, error)

# SPDX-License-Identifier: Apache-2.0
"""How alike embeddings are: their cosines, unless a recognizer compares its own."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Embeddings = NDArray[np.float32]
Similarities = NDArray[np.float32]

MAX_BEYOND_ONE = 1e-3
"""Rounding may take a similarity so far out of -1 to 1; it is brought back."""


class Comparer(Protocol):
    """Compares embeddings.

    Attributes:
        looks_back: the rows of queries before the one in question that matter to its answer.
    """

    looks_back: int

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return (Q, R) float32 similarities, -1 to 1, of (Q, *S) queries and (R, *S) references.

        Both are in the order in which they were seen.
        """
        ...


class Cosines:
    """Compares (D,) embeddings of unit length by their cosine, each pair on its own."""

    looks_back = 0

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return the (Q, R) float32 cosines of (Q, D) queries and (R, D) references."""
        # Not `@`: BLAS adds up a pair in an order that depends on where it stands and on the
        # number of cores, and two equal places would differ in the last bit instead of tying.
        products = np.einsum("qd,rd->qr", queries, references)
        similarities: Similarities = np.clip(products, -1.0, 1.0)
        return similarities


COSINES = Cosines()


def flaw_in(answer: object, shape: tuple[int, int]) -> str | None:
    """Return what is wrong with an answer that should be similarities of a shape, None if nothing.

    Args:
        answer: whatever a recognizer returned.
        shape: (Q, R).
    """
    try:
        values = np.asarray(answer, dtype=np.float64)
    except Exception:  # whatever the answer's own kind raises
        return f"a {type(answer).__name__} that is not an array of numbers"
    if values.shape != shape:
        return f"similarities of shape {values.shape}, not (queries, references) = {shape}"
    if not np.isfinite(values).all():
        count = np.count_nonzero(~np.isfinite(values))
        return f"{count} of {values.size} similarities that are NaN or infinite"
    outside = values[np.abs(values) > 1.0 + MAX_BEYOND_ONE]
    if outside.size:
        worst = outside[np.abs(outside).argmax()]
        return f"a similarity of {worst:.6g}; it must lie from -1 to 1"
    return None

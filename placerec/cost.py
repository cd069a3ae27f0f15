# SPDX-License-Identifier: Apache-2.0
"""What a recognizer costs: time to embed and to compare, and size."""

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from placerec.comparison import COSINES, Comparer, Embeddings

BATCH = 10_000
MAX_BATCH_BYTES = 256 * 2**20
"""Fewer are compared at a time where they would take up more than this."""
REPEATS = 30
ENOUGH_S = 1.0
"""No more tries after so long."""


@dataclass(frozen=True)
class Cost:
    """What one image costs.

    Attributes:
        embed_ms: median time to embed it.
        compare_ms: time to compare it with one other, in a batch of 10,000 (long ones fewer), as
            a map that is being made does it, the recognizer's look back included; the least of
            several tries, because one that took longer has waited for other work of the machine.
        dimension: how many values an embedding has.
        embedding_bytes: what they take up in memory.
    """

    embed_ms: float
    compare_ms: float
    dimension: int
    embedding_bytes: int


def measure_cost(
    embeddings: Embeddings, embed_s: NDArray[np.float64], comparer: Comparer = COSINES
) -> Cost:
    """Return the cost of the recognizer that made (N, *S) embeddings in (N,) seconds each.

    Raises:
        RecognizerError: the embeddings cannot be compared.
    """
    return Cost(
        embed_ms=1e3 * float(np.median(embed_s)),
        compare_ms=_compare_ms(embeddings[0], comparer),
        dimension=embeddings[0].size,
        embedding_bytes=embeddings[0].nbytes,
    )


def _compare_ms(embedding: Embeddings, comparer: Comparer) -> float:
    count = max(1, min(BATCH, MAX_BATCH_BYTES // embedding.nbytes))
    batch = np.repeat(embedding[None], count, axis=0)
    queries = np.repeat(embedding[None], 1 + comparer.looks_back, axis=0)
    seconds: list[float] = []
    while len(seconds) < REPEATS and sum(seconds) < ENOUGH_S:
        start = perf_counter()
        comparer.compare(queries, batch)
        seconds.append(perf_counter() - start)
    return 1e3 * min(seconds) / count

# SPDX-License-Identifier: Apache-2.0
"""What a recognizer costs: time to embed and to compare, and size."""

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

BATCH = 10_000
MAX_BATCH_BYTES = 256 * 2**20
"""Fewer are compared at a time where they would take up more than this."""
REPEATS = 30


@dataclass(frozen=True)
class Cost:
    """What one image costs.

    Attributes:
        embed_ms: median time to embed it.
        compare_ms: time to compare it with one other, in a batch of 10,000 (long ones fewer); the
            least of several tries, because one that took longer has waited for other work of the
            machine.
        dimension: how many values an embedding has.
        embedding_bytes: what they take up in memory.
    """

    embed_ms: float
    compare_ms: float
    dimension: int
    embedding_bytes: int


def measure_cost(embeddings: NDArray[np.float32], embed_s: NDArray[np.float64]) -> Cost:
    """Return the cost of the recognizer that made (N, D) embeddings in (N,) seconds each."""
    dimension = embeddings.shape[1]
    return Cost(
        embed_ms=1e3 * float(np.median(embed_s)),
        compare_ms=_compare_ms(embeddings[0]),
        dimension=dimension,
        embedding_bytes=embeddings.itemsize * dimension,
    )


def _compare_ms(embedding: NDArray[np.float32]) -> float:
    count = max(1, min(BATCH, MAX_BATCH_BYTES // embedding.nbytes))
    batch = np.tile(embedding, (count, 1))
    seconds = []
    for _ in range(REPEATS):
        start = perf_counter()
        batch @ embedding
        seconds.append(perf_counter() - start)
    return 1e3 * min(seconds) / count

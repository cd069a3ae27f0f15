# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec import cost
from placerec.cost import measure_cost


def test_cost_of_an_embedding():
    embeddings = np.full((3, 64), 0.125, np.float32)
    found = measure_cost(embeddings, np.array([0.5, 0.002, 0.001]))
    assert found.embed_ms == pytest.approx(2.0)  # the median: the first image warms things up
    assert found.dimension == 64
    assert found.embedding_bytes == 256
    assert found.compare_ms > 0.0


def test_long_embeddings_are_compared_in_batches_that_fit_into_memory(monkeypatch):
    made = []
    monkeypatch.setattr(cost.np, "tile", lambda row, shape: made.append(shape) or row[None])
    for dimension in (4096, 256 * 13 * 13):
        measure_cost(np.ones((1, dimension), np.float32), np.ones(1))
    assert made == [(10_000, 1), (1551, 1)]

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.cost import measure_cost


def test_cost_of_an_embedding():
    embeddings = np.full((3, 64), 0.125, np.float32)
    cost = measure_cost(embeddings, np.array([0.5, 0.002, 0.001]))
    assert cost.embed_ms == pytest.approx(2.0)  # the median: the first image warms things up
    assert cost.dimension == 64
    assert cost.embedding_bytes == 256
    assert cost.compare_ms > 0.0

# SPDX-License-Identifier: Apache-2.0
from dataclasses import dataclass

import numpy as np
import pytest


@dataclass
class Named:
    """Stands for the recognizer that made the embeddings."""

    fingerprint: str = "version 1"
    min_similarity: float = 0.5

    def embed(self, image):
        raise NotImplementedError


@pytest.fixture
def unit():
    """Return so many random unit vectors."""

    def make(count: int, size: int = 16, seed: int = 0) -> np.ndarray:
        rows = np.random.default_rng(seed).normal(size=(count, size))
        return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)

    return make


@pytest.fixture
def opened(tmp_path, needs_lancedb):
    """Open the store of the test, of a recognizer of this fingerprint."""
    from placerec import PlaceStore

    return lambda fingerprint="version 1": PlaceStore(tmp_path / "store", Named(fingerprint))

# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from benchmarks.network_choice.candidates import (
    PUBLISHED_WEIGHTS,
    Candidate,
    build,
    candidates,
    embed,
)
from placerec.networks import TRUNKS

TRUNK = "squeezenet"


@pytest.fixture
def published(tmp_path: Path) -> Path:
    trunk = TRUNKS[TRUNK]
    path = tmp_path / PUBLISHED_WEIGHTS[TRUNK]
    path.parent.mkdir()
    state = trunk.layers().state_dict()
    np.savez(path, **{trunk.name_in_file(name): value.numpy() for name, value in state.items()})
    return tmp_path


@pytest.mark.parametrize(("pooling", "channels"), [("covariance", 8), ("cells", None)])
def test_embeddings_of_what_was_fitted_are_centred_points_on_the_sphere(
    published: Path, pooling: str, channels: int | None
):
    images = list(np.random.default_rng(0).integers(0, 256, (24, 48, 64, 3), np.uint8))
    candidate = Candidate(TRUNK, "fire3", pooling, channels, (64, 48), 12)
    embeddings = embed(build(candidate, published, images), images)
    assert embeddings.shape == (24, 12)
    assert np.allclose(np.linalg.norm(embeddings, axis=1), 1.0, atol=1e-5)
    assert np.linalg.norm(embeddings.mean(axis=0)) < 0.3


def test_no_candidate_is_there_twice():
    names = [str(candidate) for candidate in candidates()]
    assert len(set(names)) == len(names) > 50

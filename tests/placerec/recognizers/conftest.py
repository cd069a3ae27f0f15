# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import numpy as np
import pytest

from placerec.networks import TRUNKS, PlaceNetwork

REAL_WEIGHTS = Path(
    os.environ.get("LOOPCLOSE_WEIGHTS", Path(__file__).parents[4] / "shared" / "weights")
)


@pytest.fixture
def real_weights(machine, monkeypatch):
    """Let the machine find the weights that people published, where they are here."""
    if not any(REAL_WEIGHTS.glob("squeezenet*")):
        pytest.skip(f"no squeezenet* in {REAL_WEIGHTS} (LOOPCLOSE_WEIGHTS names another place)")
    monkeypatch.setenv("LOOPCLOSE_WEIGHTS", str(REAL_WEIGHTS))


@pytest.fixture(scope="session")
def published(tmp_path_factory):
    """Return a folder with files as published, of random weights, and none of the authors'."""
    folder = tmp_path_factory.mktemp("published")
    for name in ("mobilenet_v2", "squeezenet"):
        network = PlaceNetwork(TRUNKS[name], 1, seed=4)
        state = network.features.state_dict().items()
        arrays = {TRUNKS[name].name_in_file(key): value.numpy() for key, value in state}
        (folder / name).mkdir()
        np.savez(folder / name / f"{name}_1.0.npz", **arrays)
    return folder


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Return the folder of weights of a machine that has nothing on it yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("LOOPCLOSE_WEIGHTS", raising=False)
    return tmp_path / "cache" / "loopclose" / "weights"


@pytest.fixture
def weights(machine, published, monkeypatch):
    """Let the machine find the published weights."""
    monkeypatch.setenv("LOOPCLOSE_WEIGHTS", str(published))
    return published


@pytest.fixture(scope="session")
def photographs():
    """Return 24 pictures of coloured boards, 60 x 80."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (24, 6, 8, 3), np.uint8)
    return [np.kron(image, np.ones((10, 10, 1), np.uint8)) for image in coarse]

# SPDX-License-Identifier: Apache-2.0
import os
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

DATA = Path(os.environ.get("LOOPCLOSE_DATA", Path(__file__).parents[3] / "shared" / "data"))


def pytest_collection_finish():
    # What a test computes is so small that a second thread only waits, for long on a busy machine.
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


@pytest.fixture
def real_data() -> Callable[[str], Path]:
    def find(name: str) -> Path:
        folder = DATA / name
        if not folder.is_dir():
            pytest.skip(f"{name} is not under {DATA} (LOOPCLOSE_DATA names another place)")
        return folder

    return find


@pytest.fixture
def write_image() -> Callable[..., Path]:
    def write(path: Path, seed: int = 0, channels: int = 3) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        shape = (12, 16) if channels == 1 else (12, 16, channels)
        image = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
        assert cv2.imwrite(str(path), image)
        return path

    return write

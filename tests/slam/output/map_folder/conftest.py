# SPDX-License-Identifier: Apache-2.0
"""A map of the recording that was rendered, saved once."""

import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.output.map_folder.folder import save_map, saved_map
from slam.system import Slam


@pytest.fixture(scope="session")
def finished(frames, sequence):
    """Return a run of the whole recording, and its result."""
    slam = Slam(sequence.camera, GradientRecognizer())
    for frame in frames:
        slam.process(frame)
    return slam, slam.finish()


@pytest.fixture
def folder(finished, tmp_path):
    save_map(tmp_path / "map", saved_map(*finished))
    return tmp_path / "map"

# SPDX-License-Identifier: Apache-2.0
"""A map of the recording that was rendered, saved once."""

import pytest

from slam.output.map_folder.folder import save_map, saved_map


@pytest.fixture
def folder(finished, tmp_path):
    save_map(tmp_path / "map", saved_map(*finished))
    return tmp_path / "map"

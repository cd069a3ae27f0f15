# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.training_scenes import rendered
from benchmarks.training_scenes.folder import write_folder
from placerec.datasets import open_dataset


@pytest.mark.parametrize("kind", ["room", "desk"])
def test_a_scene_is_a_recording_with_places(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(rendered, "PLACES", 3)
    write_folder(tmp_path / "scene", rendered.views(kind, 7, [], paths=False))
    scene = open_dataset(str(tmp_path / "scene"))
    assert scene.places is not None
    assert scene[0].shape == (rendered.HEIGHT_PX, rendered.WIDTH_PX, 3)
    assert len(np.unique(scene.places)) >= 3
    assert scene.comparable[~np.eye(len(scene), dtype=bool)].all()  # each view counts


def test_a_folder_that_could_not_be_finished_is_not_there(tmp_path):
    def broken():
        yield 1.0, np.zeros((4, 4, 3), np.uint8), np.eye(4)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path / "scene", broken())
    assert not (tmp_path / "scene").exists()
    write_folder(tmp_path / "scene", [(1.0, np.zeros((4, 4, 3), np.uint8), np.eye(4))])
    assert (tmp_path / "scene" / "rgb.txt").read_text() == "1.000000 rgb/1.000000.png\n"

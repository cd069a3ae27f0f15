# SPDX-License-Identifier: Apache-2.0
"""`run_slam reembed`."""

import json

import numpy as np
import pytest

from placerec.recognizer import load
from placerec.recognizers.gradients import GradientRecognizer
from slam.__main__ import main
from slam.output.map_folder.folder import load_map, save_map, saved_map
from slam.system import Slam
from slam.types import SlamError

OTHER = """
import numpy as np
class Mean:
    min_similarity = 0.5
    def embed(self, image):
        assert image.shape == (240, 320, 3)
        colour = image.mean(axis=(0, 1))
        return (colour / np.linalg.norm(colour)).astype(np.float32)
class Failing(Mean):
    calls = 0
    def embed(self, image):
        self.calls += 1
        if self.calls == 2:
            raise RuntimeError("out of paint")
        return super().embed(image)
"""


@pytest.fixture
def folder(frames, sequence, tmp_path):
    slam = Slam(sequence.camera, GradientRecognizer())
    for frame in frames[:16:4]:
        slam.process(frame)
    save_map(tmp_path / "map", saved_map(slam, slam.finish()))
    return tmp_path / "map"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Go where a module with other recognizers is."""
    (tmp_path / "paint.py").write_text(OTHER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)


def reembed(folder, recognizer):
    return main(["reembed", str(folder), "--recognizer", recognizer])


def content(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_map_is_embedded_anew_and_nothing_else_of_it_changes(folder):
    before = content(folder)
    assert reembed(folder, "paint:Mean") == 0
    after = content(folder)
    assert {name for name in after if after[name] != before[name]} == {
        "embedding.npy",
        "manifest.json",
    }
    with pytest.raises(SlamError, match="embed it anew with run_slam reembed"):
        load_map(folder, GradientRecognizer())
    loaded = load_map(folder, load("paint:Mean"))
    assert len(loaded.keyframes) > 1
    for embedding, keyframe in zip(loaded.embeddings, loaded.keyframes, strict=True):
        colour = keyframe.preview.rgb.mean(axis=(0, 1))
        np.testing.assert_allclose(embedding, colour / np.linalg.norm(colour), atol=2e-3)


def test_its_own_recognizer_embeds_it_much_as_before(folder, capsys):
    before = load_map(folder, GradientRecognizer()).embeddings.copy()
    assert reembed(folder, "gradients") == 0
    assert "this recognizer made the map's embeddings before" in capsys.readouterr().err
    after = load_map(folder, GradientRecognizer()).embeddings
    assert 0.98 < (before * after).sum(axis=1).min() < 1.0


def test_where_it_fails_the_map_stays_as_it_is(folder, capsys):
    before = content(folder)
    assert reembed(folder, "paint:Failing") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "out of paint" in error
    assert content(folder) == before
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 9}))
    assert reembed(folder, "paint:Mean") == 2
    assert "is of version 9" in capsys.readouterr().err

# SPDX-License-Identifier: Apache-2.0
import shutil
import subprocess
import sys

import numpy as np
import pytest

from placerec.certificate import certificate_of
from placerec.conformance.made_images import places
from placerec.recognizers import default
from placerec.recognizers.default import DEFAULT_GRAPH, DEFAULT_WEIGHTS, DefaultByOnnx, open_default
from placerec.recognizers.learned import LearnedRecognizer


def test_whatever_runs_it_the_answer_is_the_same():
    ours, torchs = open_default(), LearnedRecognizer()
    assert isinstance(ours, DefaultByOnnx)
    for image in places():
        np.testing.assert_allclose(ours.embed(image), torchs.embed(image), atol=1e-5)
    assert ours.min_similarity == pytest.approx(torchs.min_similarity, abs=1e-6)
    for name in ("fingerprint", "weights", "trained_on", "certificate"):
        assert getattr(ours, name) == getattr(torchs, name)
    assert certificate_of(ours) is not None


def test_torch_is_not_loaded_where_onnxruntime_is():
    code = "import sys; from placerec.recognizers.default import open_default; open_default()"
    run = subprocess.run(
        [sys.executable, "-c", f"{code}; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert not {"torch", "onnx"} & set(run.stdout.split())


def test_where_onnxruntime_is_not_installed_torch_runs_it(monkeypatch, caplog):
    monkeypatch.setattr(default, "find_spec", lambda name: None)
    assert isinstance(open_default(), LearnedRecognizer)
    assert not caplog.records


def test_a_graph_of_other_weights_is_not_used_and_that_is_said(tmp_path, monkeypatch, caplog):
    for path in (DEFAULT_GRAPH, DEFAULT_WEIGHTS, DEFAULT_WEIGHTS.with_suffix(".certificate.json")):
        shutil.copy(path, tmp_path)
    weights = tmp_path / DEFAULT_WEIGHTS.name
    with weights.open("r+b") as stream:
        stream.seek(-1, 2)
        stream.write(b"\x01")
    monkeypatch.setattr(default, "DEFAULT_GRAPH", tmp_path / DEFAULT_GRAPH.name)
    monkeypatch.setattr(default, "DEFAULT_WEIGHTS", weights)
    assert isinstance(open_default(), LearnedRecognizer)
    assert "because the graph is of other weights" in caplog.text

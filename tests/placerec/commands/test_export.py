# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.__main__ import main
from placerec.certificate import certificate_of, certificate_path, read_certificate
from placerec.commands import export
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.weights_file import save_weights
from placerec.recognizer import load


@pytest.fixture
def weights(tmp_path):
    network = PlaceNetwork(TRUNKS["mobilenet_v2"], 8, block="block2", grid=(2, 2))
    save_weights(network, tmp_path / "w.safetensors", 0.25)
    return tmp_path / "w.safetensors"


def test_what_is_written_is_the_same_recognizer(weights, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(weights)]) == 0
    assert "written to w.onnx\n" in capsys.readouterr().out
    one, other = load("w.onnx"), load(str(weights))
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
    np.testing.assert_allclose(one.embed(image), other.embed(image), atol=1e-5)
    assert one.min_similarity == 0.25 and one.certificate is None
    content = (tmp_path / "w.onnx").read_bytes()
    assert main(["export", str(weights)]) == 0
    assert (tmp_path / "w.onnx").read_bytes() == content


def test_the_certificate_goes_with_the_default(tmp_path):
    out = tmp_path / "ours.onnx"
    assert main(["export", "learned", "--out", str(out)]) == 0
    exported, default = load(str(out)), load("learned")
    certificate = read_certificate(tmp_path / "ours.certificate.json")
    assert certificate_of(exported) == certificate
    assert certificate.curve == certificate_of(default).curve
    assert exported.min_similarity == default.min_similarity


def test_what_gives_other_embeddings_is_not_written(weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(export, "_MOST_APART", -1.0)
    assert main(["export", str(weights), "--out", str(tmp_path / "w.onnx")]) == 2
    assert "what was exported gives other embeddings" in capsys.readouterr().err
    assert not (tmp_path / "w.onnx").exists()


def test_a_certificate_that_cannot_go_along_leaves_nothing_half_done(weights, tmp_path, capsys):
    certificate_path(weights).write_text("{}")
    assert main(["export", str(weights), "--out", str(tmp_path / "w.onnx")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "w.onnx").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["learned", "--out", "net.pt"], "export needs a FILE that ends in .onnx"),
        (["learned", "--out", "none/net.onnx"], "in a folder that is there: none/net.onnx"),
        (["gradients"], "gradients is no trained network, which alone can be exported"),
        (["none.safetensors"], "cannot read the weights"),
    ],
)
def test_what_cannot_be_exported_is_one_line_and_code_2(arguments, message, tmp_path, capsys):
    assert main(["export", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1

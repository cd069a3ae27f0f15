# SPDX-License-Identifier: Apache-2.0
import sys

import numpy as np
import pytest
import torch

from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.onnx_export import to_onnx
from placerec.recognizers.onnx_file import OnnxRecognizer

WAYS = [{}, {"grid": (2, 3)}, {"covariance": True}, {"words": 4}]


def _network(**way):
    return PlaceNetwork(
        TRUNKS["squeezenet"], 8, block="fire3", size_px=(97, 75), seed=1, **way
    ).eval()


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_what_is_written_embeds_as_the_network(way, tmp_path):
    network, path = _network(**way), tmp_path / "net.onnx"
    path.write_bytes(content := to_onnx(network, 0.25).SerializeToString())
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (60, 80, 3), np.uint8) for _ in range(3)]
    with torch.inference_mode():
        expected = network(network.prepare(images)).numpy()
    recognizer = OnnxRecognizer(path)
    np.testing.assert_allclose(recognizer.embed_many(images), expected, atol=1e-5)
    assert recognizer.min_similarity == 0.25
    assert recognizer.preprocessing.is_bgr
    assert to_onnx(network, 0.25).SerializeToString() == content


def test_without_onnx_one_line_says_what_to_install(monkeypatch, error_of):
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert "pip install 'loopclose[onnx]'" in error_of(to_onnx, _network(), 0.25)

# SPDX-License-Identifier: Apache-2.0
import json
import logging
import subprocess
import sys

import numpy as np
import onnxruntime
import pytest

from placerec.certificate import certificate_of, write_certificate
from placerec.conformance import check
from placerec.networks import Preprocessing
from placerec.recognizer import load
from placerec.recognizers.onnx_file import OnnxRecognizer

SETTINGS = {"mean": [0.5, 0.5, 0.5], "std": [0.25, 0.25, 0.25], "min_similarity": 0.4}
TOLD = {"placerec": json.dumps(SETTINGS)}


def _image(seed=0, height=60, width=80):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def _by_hand(image, preprocessing):
    values = preprocessing(image).reshape(3, 3, 8, 4, 8).mean(axis=(2, 4)).ravel()
    return values / np.linalg.norm(values)


HALVES = Preprocessing(32, 24, (127.5,) * 3, (63.75,) * 3)


@pytest.fixture
def network(tmp_path, write_onnx):
    return write_onnx(tmp_path / "net.onnx", metadata=TOLD)


def test_conforms(network, caplog):
    report = check(load(str(network)))
    assert report.passed, str(report)
    assert not caplog.records


def test_it_embeds_as_its_metadata_say(network):
    recognizer = load(str(network))
    assert (recognizer.min_similarity, recognizer.dimension) == (0.4, 36)
    assert recognizer.weights == "net.onnx at 32x24 px, by onnxruntime"
    np.testing.assert_allclose(recognizer.embed(_image()), _by_hand(_image(), HALVES), atol=1e-6)


def test_images_at_once_are_as_images_one_by_one(tmp_path, write_onnx):
    images = [_image(seed, 50 + seed) for seed in range(40)]  # more than go in one pass
    for first in ("n", 1):
        recognizer = OnnxRecognizer(write_onnx(tmp_path / "net.onnx", (first, 3, 24, 32)))
        one_by_one = np.array([recognizer.embed(image) for image in images])
        np.testing.assert_allclose(recognizer.embed_many(images), one_by_one, atol=1e-5)
        assert recognizer.embed_many([]).shape == (0, 36)


def test_a_device_that_is_not_there_is_one_line(network, monkeypatch, error_of):
    monkeypatch.setenv("LOOPCLOSE_DEVICE", "abacus:1")
    told = error_of(load, str(network))
    assert told.startswith("LOOPCLOSE_DEVICE=abacus:1: onnxruntime cannot use it: this build has ")
    assert "cpu" in told


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_a_device_that_does_not_start_is_one_line(network, monkeypatch, error_of):
    # The build has it, the machine has not: onnxruntime goes on without it, and tells nobody.
    providers = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: providers)
    monkeypatch.setenv("LOOPCLOSE_DEVICE", "cuda")
    told = error_of(load, str(network))
    assert told == "LOOPCLOSE_DEVICE=cuda: onnxruntime cannot use it: it does not start there"


def test_it_says_where_it_runs(network, monkeypatch):
    class Session:
        def __init__(self, path, options, providers, **others):
            self.asked, self.session = providers, RealSession(path, options)

        def get_providers(self):
            return [name for name, _ in self.asked]

        def __getattr__(self, name):
            return getattr(self.session, name)

    RealSession = onnxruntime.InferenceSession
    providers = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: providers)
    monkeypatch.setattr("onnxruntime.InferenceSession", Session)
    monkeypatch.setenv("LOOPCLOSE_DEVICE", "cuda:1")
    recognizer = load(str(network))
    assert recognizer.weights == "net.onnx at 32x24 px, by onnxruntime on cuda:1"
    assert recognizer._session.asked == [
        ("CUDAExecutionProvider", {"device_id": "1"}),
        ("CPUExecutionProvider", {}),
    ]


def test_a_file_beside_it_wins_over_the_metadata(network):
    network.with_suffix(".toml").write_text('mean = [0, 0, 0]\nstd = [1, 1, 1]\norder = "bgr"\n')
    recognizer = load(str(network))
    assert recognizer.preprocessing == Preprocessing(32, 24, (0.0,) * 3, (255.0,) * 3, is_bgr=True)
    assert recognizer.min_similarity == 0.4


def test_what_it_does_not_say_is_assumed_aloud(tmp_path, write_onnx, caplog):
    path = write_onnx(tmp_path / "net.onnx", ("n", 3, "h", "w"))
    with caplog.at_level(logging.WARNING):
        recognizer = OnnxRecognizer(path)
    prepared, threshold = (record.getMessage() for record in caplog.records)
    assert prepared == (
        "net.onnx does not say how images are prepared: taking the mean and std of ImageNet, red "
        "first and a size of 224 x 224; net.toml can say otherwise"
    )
    assert f"`placerec calibrate DATA --recognizer {path}` finds one" in threshold
    assert recognizer.min_similarity == 0.0
    path.with_suffix(".toml").write_text("size = [64, 48]\n")
    assert OnnxRecognizer(path).dimension == 3 * 6 * 8


def test_channels_may_come_last(tmp_path, write_onnx):
    path = write_onnx(tmp_path / "net.onnx", (1, 24, 32, 3), metadata=TOLD)
    expected = _by_hand(_image(), HALVES)
    np.testing.assert_allclose(OnnxRecognizer(path).embed(_image()), expected, atol=1e-6)


def test_of_several_outputs_the_only_row_or_the_one_named_is_taken(tmp_path, write_onnx, error_of):
    path, maps = tmp_path / "net.onnx", ("n", 3, 3, 4)
    write_onnx(path, outputs={"rows": ("n", "d"), "maps": maps})
    assert OnnxRecognizer(path).dimension == 36
    write_onnx(path, outputs={"rows": ("n", "d"), "maps": maps, "others": ("n", "d")})
    assert "several outputs, rows ('n', " in error_of(OnnxRecognizer, path)
    assert "by output = NAME in net.toml" in error_of(OnnxRecognizer, path)
    path.with_suffix(".toml").write_text('output = "rows"')
    assert OnnxRecognizer(path).dimension == 36
    path.with_suffix(".toml").write_text('output = "more"')
    assert error_of(OnnxRecognizer, path).startswith("output = 'more': the network has rows")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"shape": ("n", 1, 24, 32)}, "input 'image' of the network is tensor(float) of shape"),
        ({"shape": (4, 3, 24, 32)}, "it must be of floats and (N, 3, H, W)"),
        ({"last": ("Identity", {}), "outputs": {"maps": ("n", 3, 3, 4)}}, "output 'maps' of the"),
        ({"last": ("Warp", {}), "domain": "com.theirs"}, "onnxruntime cannot open it: "),
        ({"tensor_file": "weights.bin"}, "tensors in 'weights.bin', which is not beside it"),
        ({"tensor_file": "../weights.bin"}, "in a file outside its folder, '../weights.bin'"),
        ({"tensor_file": "/dev/zero"}, "in a file outside its folder, '/dev/zero'"),
        ({"tensor_file": "x" * 150}, "xxx', which is not beside it"),
        ({"metadata": {"placerec": "{"}}, "the metadata 'placerec' of the network are not JSON"),
        ({"metadata": {"placerec": "[]"}}, "the metadata 'placerec' are no names and values"),
        ({"metadata": {"placerec": '{"std": [1, 0, 1]}'}}, "std = [1, 0, 1] cannot be used"),
        ({"metadata": {"placerec": '{"size": [64, 48]}'}}, "the network takes [32, 24] (width, h"),
        ({"last": ("DepthToSpace", {"blocksize": 2})}, "does not run on images of 32 x 24; if it"),
    ],
)
def test_a_network_that_cannot_be_used_is_one_line(changes, told, tmp_path, write_onnx, error_of):
    path = write_onnx(tmp_path / "net.onnx", **changes)
    message = error_of(load, str(path))
    assert told in message
    assert message.endswith(str(path))


@pytest.mark.parametrize("content", [None, b"", b"not a network", b"\x08\x08\x12"])
def test_a_missing_or_broken_file_is_one_line(content, tmp_path, write_onnx, error_of):
    path = tmp_path / "net.onnx"
    if content is not None:
        path.write_bytes(content)
    assert error_of(load, str(path)).endswith(str(path))


def test_settings_that_nobody_knows_are_one_line(network, error_of):
    network.with_suffix(".toml").write_text("means = 3")
    message = error_of(load, str(network))
    assert message.startswith("means = 3 cannot be used for the network: ")
    assert message.endswith("net.toml")


def test_a_vector_that_is_zero_is_one_line(tmp_path, write_onnx, error_of):
    settings = {"mean": [0, 0, 0], "std": [1, 1, 1]}
    path = write_onnx(tmp_path / "net.onnx", metadata={"placerec": json.dumps(settings)})
    message = error_of(load(str(path)).embed, np.zeros((60, 80, 3), np.uint8))
    assert "a vector that is zero" in message


def test_without_onnxruntime_one_line_says_what_to_install(network, monkeypatch, error_of):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert "pip install onnxruntime" in error_of(load, str(network))


def test_torch_is_not_loaded(network):
    code = f"import sys; from placerec import load; load({str(network)!r}); print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "onnx"} & set(run.stdout.split())


def test_the_fingerprint_is_of_all_that_decides_embeddings(tmp_path, write_onnx):
    def written(tensor=1.0, settings="", metadata=TOLD):
        path = write_onnx(tmp_path / "net.onnx", metadata=metadata, tensor_file="w.bin")
        (tmp_path / "w.bin").write_bytes(np.float32(tensor).tobytes())
        path.with_suffix(".toml").write_text(settings)
        return OnnxRecognizer(path).fingerprint

    expected = written()
    assert expected.startswith("sha256:")
    assert written(settings="min_similarity = 0.9") == expected
    others = [written(tensor=2.0), written(settings='order = "bgr"'), written(metadata={})]
    assert len({expected, *others}) == 4


def test_a_damaged_certificate_stands_in_the_way_of_runs_but_not_of_a_new_one(network, error_of):
    network.with_suffix(".certificate.json").write_text("{}")
    recognizer = load(str(network))
    assert recognizer.min_similarity == 0.4
    assert "net.certificate.json" in error_of(certificate_of, recognizer)


def test_the_threshold_is_that_of_the_certificate_beside_it_if_it_is_its_own(
    network, error_of, certificate
):
    own = {"recognizer": network.name, "fingerprint": load(str(network)).fingerprint}
    certificate = certificate.model_copy(update=own)
    write_certificate(certificate, network.with_suffix(".certificate.json"))
    recognizer = load(str(network))
    assert recognizer.min_similarity == certificate.min_similarity == 0.6
    assert certificate_of(recognizer) == certificate
    network.with_suffix(".toml").write_text('order = "bgr"')
    changed = load(str(network))
    assert changed.min_similarity == 0.4
    assert "the certificate is of another network than net.onnx" in error_of(
        certificate_of, changed
    )

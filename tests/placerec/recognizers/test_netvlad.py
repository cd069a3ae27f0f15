# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from placerec.certificate import certificate_of
from placerec.conformance import check
from placerec.errors import RecognizerError
from placerec.networks import TRUNKS
from placerec.networks.preprocessing import TORCHVISION_INPUT
from placerec.recognizers.fitted_file import read_fitted, shipped, write_fitted
from placerec.recognizers.netvlad import NetVlad, whitening

SIZE_PX = (64, 48)


@pytest.fixture
def recognizer(weights, photographs, tmp_path):
    path = tmp_path / "words.safetensors"
    fitted = NetVlad.fit(photographs[:6])
    write_fitted(path, "netvlad", replace(fitted, trained_on=("boards",)))
    return NetVlad(path)


@pytest.fixture(scope="session")
def state():
    """Return a state dict of the published layout, of random numbers."""
    torch.manual_seed(0)
    encoder = TRUNKS["vgg16"].layers("conv5_3").state_dict()
    words = functional.normalize(torch.randn(64, 512))
    return {f"encoder.{name}": value for name, value in encoder.items()} | {
        "pool.conv.weight": 20.0 * words[:, :, None, None],
        "pool.centroids": words,
    }


@pytest.fixture
def on_this_machine(machine, monkeypatch):
    """Return what puts a checkpoint on a machine that looks at small images."""
    published, stand_in = NetVlad.layers
    monkeypatch.setattr(NetVlad, "layers", (replace(published, size_px=SIZE_PX), stand_in))
    machine.mkdir(parents=True)
    return lambda content: torch.save(content, machine / "netvlad_pitts30k.pth.tar")


def by_hand(state, image):
    """Return the residuals of the last convolution before its ReLU to the words, by the paper."""
    layers = TRUNKS["vgg16"].layers("conv5_3")[:-1]
    layers.load_state_dict({name[8:]: v for name, v in state.items() if name.startswith("encoder")})
    values = (image.astype(np.float32) - TORCHVISION_INPUT.mean) / TORCHVISION_INPUT.scale
    with torch.inference_mode():
        maps = layers(torch.from_numpy(values.astype(np.float32)).permute(2, 0, 1)[None])[0]
    words = state["pool.centroids"].double().numpy()
    scores = state["pool.conv.weight"].double().numpy()[:, :, 0, 0]
    residuals = np.zeros_like(words)
    for feature in maps.double().numpy().reshape(512, -1).T:
        x = feature / np.linalg.norm(feature)
        shares = np.exp(scores @ x) / np.exp(scores @ x).sum()
        residuals += shares[:, None] * (x - words)
    residuals /= np.linalg.norm(residuals, axis=1, keepdims=True)
    return (residuals / np.linalg.norm(residuals)).ravel()


@pytest.mark.parametrize("parallel", [False, True])
def test_published_weights_are_used_as_published(on_this_machine, state, parallel):
    # With notes on the training beside them, as they are published; and as trained on several GPUs.
    named = state
    if parallel:
        named = {name.replace(".", ".module.", 1): value for name, value in state.items()}
    notes = {"epoch": 3, "recalls": {1: np.float64(0.8)}, "best_score": np.float64(0.8)}
    on_this_machine({"state_dict": named, **notes})
    image = np.random.default_rng(0).integers(0, 256, (SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    recognizer = NetVlad()
    np.testing.assert_allclose(recognizer.embed(image), by_hand(state, image), atol=1e-5)
    assert recognizer.weights == (
        "netvlad conv5_3 at 64x48 px, published weights netvlad_pitts30k.pth.tar; not whitened"
    )
    assert recognizer.trained_on == () and recognizer.certificate is None


def test_a_whitening_beside_published_weights_is_used(on_this_machine, state):
    torch.manual_seed(1)
    weight, bias = torch.randn(5, 64 * 512), torch.randn(5)
    on_this_machine(
        {"state_dict": state | {"WPCA.0.weight": weight[..., None, None], "WPCA.0.bias": bias}}
    )
    image = np.random.default_rng(0).integers(0, 256, (SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    expected = weight.double().numpy() @ by_hand(state, image) + bias.double().numpy()
    found = NetVlad().embed(image)
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-4)
    assert NetVlad().weights.endswith("published weights netvlad_pitts30k.pth.tar")


def test_a_whitening_can_be_fitted_to_published_weights(
    on_this_machine, state, photographs, tmp_path
):
    on_this_machine({"state_dict": state})
    fitted = NetVlad.fit(photographs[:6])
    assert set(fitted.arrays) == {"whitening.weight", "whitening.bias"}
    write_fitted(tmp_path / "w.safetensors", "netvlad", replace(fitted, trained_on=("boards",)))
    recognizer = NetVlad(tmp_path / "w.safetensors")
    assert recognizer.embed(photographs[0]).shape == (5,)
    assert recognizer.weights.endswith("netvlad_pitts30k.pth.tar; whitening of boards")


def test_a_checkpoint_that_would_run_code_or_is_of_another_network_is_refused(
    on_this_machine, state
):
    class Code:
        def __reduce__(self):
            return print, ("ran",)

    on_this_machine({"state_dict": state, "note": Code()})
    with pytest.raises(RecognizerError, match="would run code"):
        NetVlad()
    on_this_machine({"state_dict": {k: v for k, v in state.items() if k != "pool.centroids"}})
    with pytest.raises(RecognizerError, match="there is no 'pool\\.centroids'"):
        NetVlad()


def test_whitened_rows_vary_alike_in_all_directions():
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(400, 6)) * [9, 7, 5, 4, 3, 2] @ rng.normal(size=(6, 6)) + 4
    layer = whitening(torch.from_numpy(mixed).float(), 5)
    weight, bias = (layer[f"whitening.{name}"].double().numpy() for name in ("weight", "bias"))
    white = mixed @ weight.T + bias
    assert white.shape == (400, 5)
    np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=1e-3)
    covariance = white.T @ white / len(white)
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-3)
    assert np.diag(covariance).min() > 0.8 and np.diag(covariance).max() < 1.0


def test_it_conforms(weights, photographs, tmp_path):
    # Not whitened: behind a network of random numbers that only makes more of the noise.
    fitted = NetVlad.fit(photographs[:6])
    words = {name: each for name, each in fitted.arrays.items() if "whitening" not in name}
    write_fitted(tmp_path / "w.safetensors", "netvlad", replace(fitted, arrays=words))
    report = check(NetVlad(tmp_path / "w.safetensors"))
    assert report.passed, str(report)


def test_what_is_shipped_conforms(real_weights):
    recognizer = NetVlad()
    assert certificate_of(recognizer).min_similarity == recognizer.min_similarity
    report = check(recognizer)
    assert report.passed, str(report)


def test_it_says_what_it_runs_on(recognizer):
    assert recognizer.weights == (
        "squeezenet fire5 at 227x227 px, published weights squeezenet_1.0.npz in place of "
        "NetVLAD's; 64 words and whitening of boards"
    )
    assert recognizer.trained_on == ("boards",)


def test_the_seed_decides(weights, photographs):
    first, again, other = (NetVlad.fit(photographs[:4], seed) for seed in (1, 1, 2))
    assert first.fingerprint == again.fingerprint != other.fingerprint


def test_without_weights_it_says_what_to_do(machine):
    with pytest.raises(RecognizerError, match="LOOPCLOSE_WEIGHTS"):
        NetVlad()


def test_what_comes_with_the_package_is_small_and_fits_the_layer():
    path = shipped("netvlad")
    assert path.stat().st_size < 1 << 20
    arrays = read_fitted(path, "netvlad").arrays
    assert arrays["vlad.centroids"].shape == (64, 16)
    assert arrays["local.weight"].shape == (16, 256, 1, 1)
    assert arrays["whitening.weight"].shape == (448, 64 * 16)

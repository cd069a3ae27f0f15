# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from placerec.errors import RecognizerError
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.pretrained import find_pretrained
from placerec.recognizers.feature_maps import FittedToMaps, Layer, find_maps
from placerec.recognizers.fitted_file import Fitted, write_fitted

MOBILE = Layer(TRUNKS["mobilenet_v2"], "block6", (96, 64))
SQUEEZE = Layer(TRUNKS["squeezenet"], "fire2", (96, 64))
VGG = Layer(TRUNKS["vgg16"], "conv1_1", (96, 64))


def test_maps_are_those_of_the_layer(weights, photographs):
    maps = find_maps([MOBILE])
    network = PlaceNetwork(TRUNKS["mobilenet_v2"], 1, size_px=(96, 64), seed=4).eval()
    with torch.inference_mode():
        expected = network.features[:8](network.prepare([photographs[0]]))[0].numpy()
    found = maps(photographs[0])
    assert found.shape == (64, 4, 6)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert maps.weights == (
        "mobilenet_v2 block6 at 96x64 px, published weights mobilenet_v2_1.0.npz"
    )


def test_the_first_layer_whose_weights_are_here_is_taken(weights):
    assert find_maps([VGG, SQUEEZE, MOBILE]).title == "squeezenet fire2 at 96x64 px"


def test_weights_are_looked_for_in_the_users_folder_too(machine, published):
    with pytest.raises(RecognizerError) as caught:
        find_maps([VGG, MOBILE])
    message = str(caught.value)
    assert "begins with vgg16 or mobilenet_v2" in message
    assert "LOOPCLOSE_WEIGHTS" in message
    assert message.endswith(str(machine)) and "\n" not in message
    machine.mkdir(parents=True)
    file = published / "mobilenet_v2" / "mobilenet_v2_1.0.npz"
    (machine / "MobileNet_V2.npz").symlink_to(file)
    assert find_maps([VGG, MOBILE]).title == MOBILE.title


@pytest.mark.parametrize("name", ["mobilenet_v2_netvlad.pth", "MobileNet_V2-NetVLAD_30k.pth.tar"])
def test_a_checkpoint_of_netvlad_is_not_taken_for_the_network_that_it_begins_with(
    machine, published, name
):
    machine.mkdir(parents=True)
    (machine / name).write_bytes(b"")
    with pytest.raises(RecognizerError, match="whose name begins with mobilenet_v2"):
        find_maps([MOBILE])
    assert find_pretrained("netvlad") == machine / name


def test_an_archive_is_found_before_a_file_of_torchvision(machine):
    machine.mkdir(parents=True)
    for name in ("squeezenet1_0-b66bff10.pth", "squeezenet_v1.0.npz"):
        (machine / name).write_bytes(b"")
    assert find_pretrained("squeezenet") == machine / "squeezenet_v1.0.npz"


def test_a_folder_is_no_file_of_weights(machine):
    (machine / "mobilenet_v2.npz").mkdir(parents=True)
    assert find_pretrained("mobilenet_v2") is None


def test_fingerprints_tell_layers_sizes_and_weights_apart(weights, tmp_path, monkeypatch):
    others = (
        SQUEEZE,
        Layer(MOBILE.trunk, "block5", (96, 64)),
        Layer(MOBILE.trunk, "block6", (64, 64)),
    )
    seen = {find_maps([layer]).fingerprint for layer in (MOBILE, *others)}
    assert len(seen) == 4
    network = PlaceNetwork(TRUNKS["mobilenet_v2"], 1, seed=5)
    name_in_file = TRUNKS["mobilenet_v2"].name_in_file
    state = network.features.state_dict().items()
    np.savez(tmp_path / "mobilenet_v2.npz", **{name_in_file(k): v.numpy() for k, v in state})
    monkeypatch.setenv("LOOPCLOSE_WEIGHTS", str(tmp_path))
    assert find_maps([MOBILE]).fingerprint not in seen


def test_what_was_fitted_needs_the_same_layer_and_weights(weights, tmp_path):
    class Mine(FittedToMaps):
        name, layers = "mine", (SQUEEZE, MOBILE)

    def read(facts):
        write_fitted(tmp_path / "w.safetensors", "mine", Fitted({}, facts))
        return Mine(tmp_path / "w.safetensors")

    facts = find_maps([MOBILE]).facts
    assert read(facts)._maps.title == MOBILE.title
    for wrong in ({}, facts | {"weights": "others"}, facts | {"layer": "another"}):
        with pytest.raises(RecognizerError, match="placerec fit mine FOLDER"):
            read(wrong)
    Mine.layers = (SQUEEZE,)
    with pytest.raises(RecognizerError, match="placerec fit mine FOLDER"):
        read(facts)

# SPDX-License-Identifier: Apache-2.0
import json
import pickle

import pytest
import safetensors.torch
import torch
from torch import nn

from placerec.errors import RecognizerError
from placerec.networks import TRUNKS, PlaceNetwork, Preprocessing, Trunk
from placerec.networks.weights_file import load_weights, save_weights, set_min_similarity

PLAIN = Preprocessing(16, 12, (0.0, 0.0, 0.0), (255.0, 255.0, 255.0))
TINY = Trunk("tiny", lambda: nn.Sequential(nn.Conv2d(3, 5, 3), nn.BatchNorm2d(5)), PLAIN)


def _network(**arguments):
    return PlaceNetwork(
        TRUNKS["mobilenet_v2"], 8, block="block1", size_px=(48, 32), grid=(2, 3), **arguments
    )


def test_network_comes_back_as_it_was_but_for_half_precision(tmp_path):
    saved = _network(seed=4)
    save_weights(saved, tmp_path / "w.safetensors", 0.25)
    network, min_similarity = load_weights(tmp_path / "w.safetensors")
    assert min_similarity == 0.25
    assert (network.trunk.name, network.block, network.grid) == ("mobilenet_v2", "block1", (2, 3))
    assert network.preprocessing == saved.preprocessing
    assert not network.training
    for name, value in saved.state_dict().items():
        torch.testing.assert_close(network.state_dict()[name], value.half().float(), rtol=0, atol=0)


def test_words_come_back_too(tmp_path):
    saved = PlaceNetwork(TRUNKS["mobilenet_v2"], 8, block="block1", size_px=(48, 32), words=3)
    save_weights(saved, tmp_path / "w.safetensors", 0.25)
    network, _ = load_weights(tmp_path / "w.safetensors")
    assert network.words == 3
    found = network.state_dict()["pool.1.centroids"]
    torch.testing.assert_close(found, saved.state_dict()["pool.1.centroids"].half().float())


def test_same_network_same_bytes_and_saving_again_changes_nothing(tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    save_weights(_network(), first, 0.5)
    save_weights(load_weights(first)[0], again, 0.5)
    assert first.read_bytes() == again.read_bytes()
    save_weights(_network(seed=1), again, 0.5)
    assert first.read_bytes() != again.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again", "first"]


def test_another_threshold_changes_nothing_else(tmp_path):
    changed, expected = tmp_path / "changed", tmp_path / "expected"
    save_weights(PlaceNetwork(TINY, 3), changed, 0.5)  # of a trunk that need not be known
    save_weights(PlaceNetwork(TINY, 3), expected, 0.75)
    set_min_similarity(changed, 0.75)
    assert changed.read_bytes() == expected.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["changed", "expected"]


def test_threshold_of_what_is_no_weights_file_is_not_set(tmp_path):
    (tmp_path / "w").write_bytes(b"my thesis")
    with pytest.raises(RecognizerError, match="not a whole safetensors file"):
        set_min_similarity(tmp_path / "w", 0.5)
    assert (tmp_path / "w").read_bytes() == b"my thesis"


def test_own_trunk_is_handed_over(tmp_path):
    save_weights(PlaceNetwork(TINY, 3), tmp_path / "w", 0.0)
    assert load_weights(tmp_path / "w", [TINY])[0].dimension == 3
    _refuse(tmp_path / "w", "for trunk 'tiny', which is not among alexnet")


def _refuse(path, message):
    with pytest.raises(RecognizerError, match=message) as error:
        load_weights(path)
    assert "\n" not in str(error.value)
    assert str(error.value).endswith(str(path))


class _Evil:
    def __reduce__(self):
        return (pytest.fail, ("a pickle ran",))


def test_what_is_no_weights_file_is_refused(tmp_path):
    path = tmp_path / "weights"
    _refuse(path, "cannot read the weights")
    path.mkdir()
    _refuse(path, "cannot read the weights")
    path = tmp_path / "file"
    path.write_bytes(b"")
    _refuse(path, "not a whole safetensors file")
    path.write_bytes(pickle.dumps(_Evil()))
    _refuse(path, "a pickle is never opened")
    torch.save({"fully_connected.weight": _Evil()}, path)
    _refuse(path, "a pickle is never opened")


@pytest.mark.parametrize("kept", [5, 100, 0.5, -1])
def test_truncated_file_is_refused(tmp_path, kept):
    save_weights(_network(), tmp_path / "w", 0.5)
    content = (tmp_path / "w").read_bytes()
    (tmp_path / "w").write_bytes(content[: int(kept * len(content)) if kept == 0.5 else kept])
    _refuse(tmp_path / "w", "not a whole safetensors file")


def _described(**changes):
    described = {
        "trunk": "mobilenet_v2",
        "block": "block1",
        "grid": [2, 3],
        "size_px": [48, 32],
        "min_similarity": 0.5,
    }
    return {"placerec": json.dumps(described | changes)}


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "not of a place network"),
        ({"placerec": "{"}, "not of a place network"),
        ({"placerec": "[" * 9999}, "not of a place network"),
        (_described(size_px=[10**9, 10**9]), r"size = .* both from 1 to 4096"),
        (_described(grid=[10**9, 1]), r"grid = .* both from 1 to 256"),
        (_described(words=10**9), "words = 1000000000: 10000 at most"),
        (_described(min_similarity=2.0), "not of a place network"),
        (_described(more=1), "not of a place network"),
        (_described(trunk="alexnet"), "has no block 'block1'"),
        (_described(trunk="alexnet", block=None), "does not run"),
        (_described(block="block2"), "do not fit their network"),
        (_described(block="block99"), "no block 'block99'"),
        (_described(grid=None), "do not fit their network"),
    ],
)
def test_weights_of_another_network_are_refused(tmp_path, metadata, message):
    state = {name: value.contiguous() for name, value in _network().state_dict().items()}
    safetensors.torch.save_file(state, tmp_path / "w", metadata)
    _refuse(tmp_path / "w", message)


def test_weights_that_are_not_finite_are_neither_written_nor_read(tmp_path):
    network = _network()
    save_weights(network, tmp_path / "w", 0.5)
    before = (tmp_path / "w").read_bytes()
    with torch.no_grad():
        network.fully_connected.bias[2] = 1e6
    with pytest.raises(RecognizerError, match=r"fully_connected\.bias are not finite"):
        save_weights(network, tmp_path / "w", 0.5)
    assert (tmp_path / "w").read_bytes() == before
    state = {name: value.contiguous() for name, value in network.state_dict().items()}
    state["fully_connected.bias"][1] = torch.nan
    safetensors.torch.save_file(state, tmp_path / "w", _described())
    _refuse(tmp_path / "w", "NaN or infinite")

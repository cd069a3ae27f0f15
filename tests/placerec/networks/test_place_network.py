# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch
from torch import nn

from placerec.errors import RecognizerError
from placerec.networks import TRUNKS, PlaceNetwork, Preprocessing, Trunk

PLAIN = Preprocessing(16, 12, (0.0, 0.0, 0.0), (255.0, 255.0, 255.0))
TINY = Trunk("tiny", lambda: nn.Sequential(nn.Conv2d(3, 5, 3), nn.ReLU()), PLAIN, {"first": 1})


def _images(count, seed=0):
    return [
        np.random.default_rng(seed + i).integers(0, 256, (30, 40, 3), np.uint8)
        for i in range(count)
    ]


@pytest.mark.parametrize("name", sorted(TRUNKS))
@pytest.mark.parametrize("dimension", [1, 37])
def test_every_trunk_ends_on_the_unit_sphere(name, dimension):
    network = PlaceNetwork(TRUNKS[name], dimension, size_px=(96, 72), grid=(1, 2)).eval()
    with torch.inference_mode():
        embeddings = network(network.prepare(_images(3)))
    assert embeddings.shape == (3, dimension)
    torch.testing.assert_close(embeddings.norm(dim=1), torch.ones(3))
    assert network.dimension == dimension


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("alexnet", 2469696),
        ("vgg16", 14714688),
        ("squeezenet", 735424),
        ("mobilenet_v2", 1795936),
    ],
)
def test_trunks_have_as_many_parameters_as_their_published_weights(name, parameters):
    with torch.device("meta"):
        layers = TRUNKS[name].layers()
    assert sum(p.numel() for p in layers.parameters()) == parameters


@pytest.mark.parametrize(
    ("name", "block", "shape"),
    [
        ("mobilenet_v2", "block16", (320, 5, 6)),
        ("mobilenet_v2", "block13", (160, 5, 6)),
        ("mobilenet_v2", "block6", (64, 9, 12)),
        ("mobilenet_v2", "stem", (32, 72, 96)),
        ("squeezenet", "fire9", (512, 13, 13)),
        ("squeezenet", "fire5", (256, 27, 27)),
        ("alexnet", "conv3", (384, 13, 13)),
        ("alexnet", "pool5", (256, 6, 6)),
        ("vgg16", "pool1", (64, 112, 112)),
    ],
)
def test_trunk_is_cut_after_a_block(name, block, shape):
    network = PlaceNetwork(TRUNKS[name], 2, block=block, grid=(1, 1)).eval()
    with torch.inference_mode():
        maps = network.features(network.prepare(_images(1)))
    assert maps.shape[1:] == shape


def test_every_block_is_the_last_layer_that_is_kept():
    for trunk in TRUNKS.values():
        with torch.device("meta"):
            whole = trunk.build()
        assert max(trunk.blocks.values()) == len(whole)
        assert list(trunk.blocks.values()) == sorted(set(trunk.blocks.values()))


def test_torchvision_names():
    for name, last in (("alexnet", "features.10.weight"), ("vgg16", "features.28.bias")):
        network = PlaceNetwork(TRUNKS[name], 2, size_px=(64, 64))
        names = list(network.state_dict())
        assert names[0] == "features.0.weight"
        assert last in names
        assert names[-2:] == ["fully_connected.weight", "fully_connected.bias"]


def test_own_module_and_its_flattened_map():
    network = PlaceNetwork(TINY, 7)
    assert network.fully_connected.in_features == 5 * 10 * 14
    pooled = PlaceNetwork(TINY, 7, grid=(2, 3), block="first")
    assert pooled.fully_connected.in_features == 5 * 2 * 3
    assert len(pooled.features) == 1


def test_own_weights_are_kept():
    mine = TINY.build()
    before = mine[0].weight.clone()
    network = PlaceNetwork(Trunk("mine", lambda: mine, PLAIN), 4)
    assert torch.equal(network.features[0].weight, before)


def test_weights_come_from_the_seed_and_the_callers_random_numbers_are_left_alone():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, again, other = (PlaceNetwork(TINY, 4, seed=s) for s in (1, 1, 2))
    assert torch.equal(torch.rand(3), expected)
    for name, value in first.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
    assert not torch.equal(first.fully_connected.weight, other.fully_connected.weight)


def test_images_of_several_sizes_are_one_batch():
    images = [np.zeros((9, 9, 3), np.uint8), np.zeros((99, 50), np.uint8)]
    assert PlaceNetwork(TINY, 4).prepare(images).shape == (2, 3, 12, 16)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PlaceNetwork(TINY, 0), "dimension = 0"),
        (lambda: PlaceNetwork(TINY, 4, block="last"), "no block 'last'; it has: first"),
        (lambda: PlaceNetwork(TRUNKS["alexnet"], 4, size_px=(20, 20)), "does not run"),
        (lambda: PlaceNetwork(Trunk("flat", nn.Flatten, PLAIN), 4), "gives \\(1, 576\\)"),
        (
            lambda: PlaceNetwork(Trunk("whole", nn.Flatten, PLAIN, {"x": 1}), 4, block="x"),
            "cannot be cut",
        ),
    ],
)
def test_networks_that_cannot_be(make, message):
    with pytest.raises(RecognizerError, match=message):
        make()


def test_maps_may_be_described_by_words():
    network = PlaceNetwork(TINY, 7, words=3)
    assert network(network.prepare(_images(2))).shape == (2, 7)
    assert network.flatten(torch.rand(2, 5, 10, 14)).shape == (2, 15)
    for wrong in ({"words": 1}, {"words": 4, "covariance": True}):
        with pytest.raises(RecognizerError, match="2 or more, and not together with covariance"):
            PlaceNetwork(TINY, 7, **wrong)

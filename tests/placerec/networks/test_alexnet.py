# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from placerec.errors import RecognizerError
from placerec.networks import PlaceNetwork
from placerec.networks.alexnet import CAFFENET
from placerec.networks.pretrained import load_pretrained

CAFFES = {
    "conv1": (96, 55),
    "conv2": (256, 27),
    "conv3": (384, 13),
    "conv4": (384, 13),
    "conv5": (256, 13),
}
"""Channels and size of each layer's maps as Caffe reports them."""


@pytest.mark.parametrize("block", CAFFES)
def test_maps_of_caffenet_have_caffes_shapes(block):
    channels, size = CAFFES[block]
    with torch.inference_mode():
        maps = CAFFENET.layers(block)(torch.zeros(1, 3, 227, 227))
    assert maps.shape == (1, channels, size, size)
    assert (maps >= 0).all()


def test_caffenet_has_as_many_weights_as_caffes():
    counts = [sum(p.numel() for p in m.parameters()) for m in CAFFENET.layers()]
    assert [count for count in counts if count] == [34_944, 307_456, 885_120, 663_936, 442_624]


def test_weights_of_caffe_load_by_path_and_those_of_another_network_do_not(
    tmp_path, write_caffemodel
):
    source = PlaceNetwork(CAFFENET, 1, seed=3)
    path = write_caffemodel(tmp_path / "net.caffemodel", source.features)
    network = PlaceNetwork(CAFFENET, 1, block="conv3")
    load_pretrained(network, path)
    assert torch.equal(network.features.conv2.weight, source.features.conv2.weight)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(RecognizerError, match="damaged"):
        load_pretrained(network, path)
    write_caffemodel(path, source.features[:1])
    with pytest.raises(
        RecognizerError, match=r"not weights of caffenet: there is no conv2\.weight"
    ):
        load_pretrained(network, path)


def test_to_caffenet_blue_comes_first_and_the_mean_of_imagenet_is_removed():
    network = PlaceNetwork(CAFFENET, 1, block="conv1")
    image = np.full((20, 30, 3), (223, 127, 107), np.uint8)
    assert network.prepare([image])[0, :, 5, 5].tolist() == [3.0, 10.0, 100.0]

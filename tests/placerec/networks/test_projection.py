# SPDX-License-Identifier: Apache-2.0
import pytest
import torch
from torch import nn

from placerec.networks import PlaceNetwork, Preprocessing, Trunk
from placerec.networks.projection import start_from_principal_components

PLAIN = Preprocessing(8, 6, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
IDENTITY = Trunk("identity", nn.Identity, PLAIN)  # 3 x 6 x 8 = 144 values


def _values(count, seed=0):
    random = torch.Generator().manual_seed(seed)
    return torch.randn(count, 144, generator=random) * torch.linspace(3, 0.1, 144) + 5.0


@pytest.mark.parametrize(("dimension", "count"), [(30, 200), (60, 20), (144, 50)])
def test_rows_are_orthonormal_and_the_mean_goes_to_zero(dimension, count):
    network, values = PlaceNetwork(IDENTITY, dimension), _values(count)
    start_from_principal_components(network, values)
    weight = network.fully_connected.weight
    torch.testing.assert_close(weight @ weight.T, torch.eye(dimension), atol=1e-4, rtol=0)
    outputs = network.fully_connected(values)
    torch.testing.assert_close(outputs.mean(0), torch.zeros(dimension), atol=1e-4, rtol=0)


def test_strongest_components_come_first():
    network, values = PlaceNetwork(IDENTITY, 30), _values(500)
    start_from_principal_components(network, values)
    spread = network.fully_connected(values).std(0)
    assert (spread.diff() <= 1e-4).all()
    assert spread[0] > 2.5


def test_angles_between_the_given_maps_are_kept():
    network, values = PlaceNetwork(IDENTITY, 100), _values(40)
    start_from_principal_components(network, values)
    embeddings = network.project(values.reshape(40, 3, 6, 8))
    expected = nn.functional.normalize(values - values.mean(0))
    torch.testing.assert_close(embeddings @ embeddings.T, expected @ expected.T, atol=1e-4, rtol=0)


def test_more_rows_than_values_and_maps_that_are_all_the_same():
    network = PlaceNetwork(IDENTITY, 150)
    start_from_principal_components(network, _values(300))
    assert torch.count_nonzero(network.fully_connected.weight[144:]) == 0
    start_from_principal_components(network, torch.ones(5, 144))
    assert torch.isfinite(network.fully_connected.weight).all()

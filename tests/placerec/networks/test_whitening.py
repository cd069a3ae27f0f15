# SPDX-License-Identifier: Apache-2.0
import pytest
import torch
from torch import nn

from placerec.networks import PlaceNetwork, Preprocessing, Trunk
from placerec.networks.whitening import merge, whiten

PLAIN = Preprocessing(8, 6, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
IDENTITY = Trunk("identity", nn.Identity, PLAIN)  # 3 x 6 x 8 = 144 values


def _values(count, seed=0):
    random = torch.Generator().manual_seed(seed)
    return torch.randn(count, 144, generator=random) * torch.linspace(3, 0.1, 144) + 5.0


def _whitened(dimension, values):
    network = PlaceNetwork(IDENTITY, dimension)
    whiten(network, values)
    return network.fully_connected


@pytest.mark.parametrize(("dimension", "count"), [(30, 400), (60, 90), (144, 600)])
def test_directions_are_uncorrelated_centred_and_about_as_strong(dimension, count):
    values = _values(count)
    with torch.no_grad():
        outputs = _whitened(dimension, values)(values)
    covariance = outputs.T @ outputs / count
    torch.testing.assert_close(outputs.mean(0), torch.zeros(dimension), atol=1e-4, rtol=0)
    strengths = covariance.diagonal()
    torch.testing.assert_close(covariance, strengths.diag(), atol=1e-3, rtol=0)
    assert (strengths.diff() <= 1e-4).all()  # strongest first
    assert 0.5 < strengths[dimension // 2] <= strengths[0] <= 1.001


def test_more_values_than_components_are_random_mixtures_by_the_seed():
    values = _values(40)
    layer = _whitened(100, values)
    assert layer.whitening.shape[0] == 40
    mixtures = layer.weight[40:]
    assert (mixtures.norm(dim=1) > 0.5).all()
    torch.testing.assert_close(mixtures, _whitened(100, values).weight[40:])


def test_images_that_are_all_the_same_make_finite_weights():
    layer = _whitened(10, torch.ones(5, 144))
    assert all(torch.isfinite(value).all() for value in layer.state_dict().values())


def test_one_matrix_says_the_same():
    values, network = _values(50), PlaceNetwork(IDENTITY, 20)
    whiten(network, values)
    with torch.no_grad():
        network.fully_connected.bias += 0.3
        before = network.fully_connected(values)
        merge(network)
        after = network.fully_connected(values)
    assert isinstance(network.fully_connected, nn.Linear)
    torch.testing.assert_close(after, before, atol=1e-4, rtol=1e-4)
    layer = network.fully_connected
    merge(network)  # of one matrix: nothing to do
    assert network.fully_connected is layer


def test_whitening_is_not_learned():
    layer = _whitened(10, _values(50))
    assert {name for name, _ in layer.named_parameters()} == {"weight", "bias"}

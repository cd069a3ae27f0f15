# SPDX-License-Identifier: Apache-2.0
import numpy as np
import torch

from placerec.networks import TRUNKS, PlaceNetwork
from placerec.training.adaptation import BEYOND, WITHIN, adapt_last_layer, spread_of


def _network():
    return PlaceNetwork(TRUNKS["mobilenet_v2"], 6, block="block1", size_px=(48, 32), grid=(2, 3))


def _factor(network, within, beyond):
    """Return the (D, D) matrix that adapting multiplies the last layer by."""
    layer = network.fully_connected
    before = torch.cat([layer.weight, layer.bias[:, None]], dim=1).detach().clone().double()
    adapt_last_layer(network, within, beyond)
    after = torch.cat([layer.weight, layer.bias[:, None]], dim=1).detach().double()
    return np.linalg.lstsq(before.T.numpy(), after.T.numpy())[0].T


def test_the_spread_is_the_mean_over_all_pairs():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(7, 6)).astype(np.float32)
    pairs = np.triu(rng.random((7, 7)) < 0.5, 1)
    pairs |= pairs.T
    outer = [
        np.outer(vectors[i] - vectors[j], vectors[i] - vectors[j])
        for i, j in np.argwhere(pairs).tolist()
    ]
    np.testing.assert_allclose(spread_of(vectors, pairs), np.mean(outer, axis=0), atol=1e-5)
    np.testing.assert_array_equal(spread_of(vectors, np.zeros((7, 7), np.bool_)), 0.0)


def test_what_changes_within_a_place_counts_less_and_what_changes_beyond_it_more():
    within, beyond = np.diag([3.0, 0, 0, 0, 0, 0]), np.diag([0, 7.0, 0, 0, 0, 0])
    factor = _factor(_network(), [within], [beyond])
    less, more = (1 + 6 / WITHIN) ** -0.5, (1 + 6 / BEYOND) ** 0.5
    np.testing.assert_allclose(factor, np.diag([less, more, 1, 1, 1, 1]), atol=1e-4)


def test_recordings_count_the_same_however_far_their_embeddings_spread():
    one, other = np.diag([1.0, 0, 0, 0, 0, 0]), np.diag([0, 100.0, 0, 0, 0, 0])
    factor = _factor(_network(), [one, other], [np.zeros((6, 6))] * 2)
    less = (1 + 3 / WITHIN) ** -0.5
    np.testing.assert_allclose(factor, np.diag([less, less, 1, 1, 1, 1]), atol=1e-4)


def test_where_nothing_spreads_a_network_stays_what_it_is():
    factor = _factor(_network(), [np.zeros((6, 6))], [np.zeros((6, 6))])
    np.testing.assert_allclose(factor, np.eye(6), atol=1e-4)

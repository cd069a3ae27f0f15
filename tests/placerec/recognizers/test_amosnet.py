# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch
from torch.nn import functional

from placerec.conformance import check
from placerec.errors import RecognizerError
from placerec.networks import PlaceNetwork
from placerec.networks.alexnet import CAFFENET
from placerec.recognizers.amosnet import AmosNet, HybridNet, spatial_pyramid


@pytest.mark.parametrize("shape", [(3, 13, 13), (2, 6, 9), (4, 4, 5)])
def test_the_pyramid_is_that_of_adaptive_pooling(shape):
    maps = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    levels = [
        functional.adaptive_max_pool2d(torch.from_numpy(maps), count).flatten(1).T.flatten()
        for count in (4, 3, 2, 1)
    ]
    assert spatial_pyramid(maps).tolist() == torch.cat(levels).tolist()


def test_comparing_is_the_sum_of_absolute_differences(weights):
    recognizer = AmosNet()
    rows = np.random.default_rng(1).random((300, 20)).astype(np.float32)
    rows /= rows.sum(axis=1, keepdims=True)
    found = recognizer.compare(rows[:3], rows)
    for i in range(3):
        for j in range(300):
            differences = sum(
                abs(float(a) - float(b)) for a, b in zip(rows[i], rows[j], strict=True)
            )
            assert found[i, j] == pytest.approx(1 - differences / 2, abs=1e-6)
    assert found[:, :3].diagonal().tolist() == [1.0, 1.0, 1.0]


def test_the_order_is_by_distance_and_nothing_shared_is_no_similarity(weights):
    recognizer = AmosNet()
    rows = np.float32([[1, 0, 0], [0.5, 0.5, 0], [0, 0, 1]])
    assert recognizer.compare(rows[:1], rows).tolist() == [[1.0, 0.5, 0.0]]


@pytest.mark.parametrize("kind", [AmosNet, HybridNet])
def test_in_place_of_the_authors_weights_it_runs_on_what_is_here_and_says_so(weights, kind):
    recognizer = kind()
    assert recognizer.weights == (
        "squeezenet fire9 at 227x227 px, published weights squeezenet_1.0.npz "
        f"in place of {kind.__name__}'s"
    )
    assert recognizer.embed(np.zeros((9, 9, 3), np.uint8)).shape == (512 * 30,)


def test_it_conforms_but_for_the_threshold_of_trained_filters(weights):
    failed = {one.check.name for one in check(AmosNet()).findings if one.failed}
    assert failed <= {"min_similarity keeps others out"}  # random filters see all images alike


def test_the_authors_weights_go_before_others(weights, machine, write_caffemodel, photographs):
    machine.mkdir(parents=True)
    network = PlaceNetwork(CAFFENET, 1, seed=9).eval()
    write_caffemodel(machine / "amosnet.caffemodel", network.features)
    recognizer = AmosNet()
    assert (
        recognizer.weights == "caffenet conv5 at 227x227 px, published weights amosnet.caffemodel"
    )
    with torch.inference_mode():
        maps = network.features(network.prepare([photographs[0]]))[0]
    assert maps.shape == (256, 13, 13)
    expected = spatial_pyramid(maps.numpy())
    assert recognizer.embed(photographs[0]) == pytest.approx(expected / expected.sum(), abs=1e-6)
    assert "in place of HybridNet's" in HybridNet().weights


def test_without_weights_it_says_what_to_do(machine):
    with pytest.raises(RecognizerError, match="begins with HybridNet or alexnet or squeezenet"):
        HybridNet()

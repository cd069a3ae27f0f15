# SPDX-License-Identifier: Apache-2.0
import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from placerec.datasets import open_collection
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.weights_file import load_weights, save_weights
from placerec.recognizer import load
from placerec.recognizers.learned import LearnedRecognizer

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "train_default.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark_that_trains", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_recordings_become_one_collection_in_their_order(benchmark, tmp_path):
    for image in ("b/query", "b/ref", "a/query", "a/ref"):
        (tmp_path / image).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / image / "0.png"), np.zeros((12, 16, 3), np.uint8))
    for _ in range(2):  # what is there is not done again
        folder = benchmark._together(tmp_path / "links", [tmp_path / "b", tmp_path / "a"])
    assert [dataset.name for dataset in open_collection(str(folder))] == ["b", "a"]


def test_the_twin_in_the_repository_is_the_default_network_with_other_values(benchmark):
    twin, default = load(str(benchmark.SHIPPED["triplet"])), LearnedRecognizer()
    ours, others = (each.network.state_dict() for each in (twin, default))
    assert {name: value.shape for name, value in ours.items()} == {
        name: value.shape for name, value in others.items()
    }
    assert twin.network.preprocessing == default.network.preprocessing
    assert twin.fingerprint != default.fingerprint
    assert twin.certificate.min_similarity == pytest.approx(twin.min_similarity, abs=1e-6)


def test_trunks_are_averaged(benchmark, tmp_path):
    networks, paths = [], [tmp_path / f"{k}.safetensors" for k in range(2)]
    for k, path in enumerate(paths):
        networks.append(PlaceNetwork(TRUNKS["mobilenet_v2"], 4, block="block1", seed=k))
        save_weights(networks[-1], path, 0.5)
    average, _ = load_weights(benchmark._average(paths, tmp_path / "average.safetensors"))
    first, second = (network.features.state_dict() for network in networks)
    for name, value in average.features.state_dict().items():
        torch.testing.assert_close(value, (first[name] + second[name]) / 2, atol=1e-3, rtol=1e-3)

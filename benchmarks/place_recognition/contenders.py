# SPDX-License-Identifier: Apache-2.0
"""What is measured: trained networks, what they start from, single untrained layers, gradients."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.place_recognition.trainings import TRUNK_PLANS
from placerec.datasets import PlaceDataset
from placerec.evaluation.embeddings import embed_dataset
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.pretrained import load_pretrained
from placerec.recognizer import PlaceRecognizer
from placerec.recognizers.gradients import GradientRecognizer
from placerec.recognizers.learned import LearnedRecognizer

Embeddings = NDArray[np.float32]

GRADIENTS = "gradients"
BLOCKS = {
    "mobilenet_v2": ("block3", "block6", "block9", "block12", "block13", "block15", "block16"),
    "squeezenet": ("fire3", "fire5", "fire7", "fire8", "fire9"),
    "alexnet": ("conv1", "conv2", "conv3", "conv4", "conv5"),
    "vgg16": ("conv2_2", "conv3_3", "conv4_3", "conv5_3"),
}
"""Where the layers of a trunk are looked at without any training."""
OWN_SIZES_PX = {"mobilenet_v2": ((160, 120), (192, 144)), "squeezenet": ((160, 120), (224, 168))}
"""Sizes to look at them at, where there are others than that of the training."""
CELLS = (3, 4)
FLATTENED, POOLED = "flattened, mean removed", f"pooled to {CELLS[0]}x{CELLS[1]} cells"
IMAGES_PER_PASS = 16


@dataclass(frozen=True)
class Contender:
    """Something with embeddings.

    Attributes:
        name: unique; for files, too.
        fingerprint: another one where the embeddings are others.
        embed: returns the (N, D) unit-length embeddings of a dataset.
    """

    name: str
    fingerprint: str
    embed: Callable[[PlaceDataset], Embeddings]


def gradients() -> Contender:
    """Return the built-in recognizer without weights."""
    return Contender(GRADIENTS, "1", partial(_embed, GradientRecognizer))


def learned(name: str, weights: Path) -> Contender:
    """Return a trained network, read when it is needed."""
    fingerprint = hashlib.sha256(weights.read_bytes()).hexdigest()
    return Contender(name, fingerprint, partial(_embed, partial(LearnedRecognizer, weights)))


def _embed(make: Callable[[], PlaceRecognizer], dataset: PlaceDataset) -> Embeddings:
    return embed_dataset(make(), dataset).embeddings


def untrained_layers(trunk: str, trunk_weights: Path) -> list[Contender]:
    """Return the layers of a trunk as they are before any training, in two ways each."""
    sizes = OWN_SIZES_PX.get(trunk, (TRUNK_PLANS[trunk].size or (0, 0),))
    return [layer for size in sizes for layer in _layers(trunk, size, trunk_weights)]


def _layers(trunk: str, size: tuple[int, int], trunk_weights: Path) -> Iterator[Contender]:
    kept: dict[str, dict[str, Embeddings]] = {}

    def embed(key: str, dataset: PlaceDataset) -> Embeddings:
        # One pass for all layers; only the last dataset's are kept, for they take much memory.
        if dataset.name not in kept:
            kept.clear()
            kept[dataset.name] = _embed_layers(trunk, size, trunk_weights, dataset)
        return kept[dataset.name][key]

    for block in BLOCKS[trunk]:
        for way in (FLATTENED, POOLED):
            key = f"{block} at {size[0]}x{size[1]}, {way}"
            yield Contender(f"{trunk} {key}", key, partial(embed, key))


def _embed_layers(
    trunk: str, size: tuple[int, int], trunk_weights: Path, dataset: PlaceDataset
) -> dict[str, Embeddings]:
    network = PlaceNetwork(TRUNKS[trunk], 1, size_px=size)
    weights = TRUNK_PLANS[trunk].weights
    if weights is not None:
        load_pretrained(network, trunk_weights / weights)
    network.eval()
    flat: dict[str, list[Tensor]] = {block: [] for block in BLOCKS[trunk]}
    cells: dict[str, list[Tensor]] = {block: [] for block in BLOCKS[trunk]}
    found: dict[str, Embeddings] = {}
    with torch.inference_mode():
        for start in range(0, len(dataset), IMAGES_PER_PASS):
            end = min(start + IMAGES_PER_PASS, len(dataset))
            images = [dataset[i] for i in range(start, end)]
            for block, maps in _maps(network, network.prepare(images)):
                flat[block].append(maps.flatten(start_dim=1))
                pooled = functional.adaptive_avg_pool2d(maps, CELLS)
                cells[block].append(pooled.flatten(start_dim=1))
        for block in BLOCKS[trunk]:
            at, values = f"{block} at {size[0]}x{size[1]}", torch.cat(flat.pop(block))
            found[f"{at}, {FLATTENED}"] = functional.normalize(values - values.mean(dim=0)).numpy()
            found[f"{at}, {POOLED}"] = functional.normalize(torch.cat(cells.pop(block))).numpy()
    return found


def _maps(network: PlaceNetwork, maps: Tensor) -> Iterator[tuple[str, Tensor]]:
    assert isinstance(network.features, nn.Sequential)
    ends = {network.trunk.layer_count(block): block for block in BLOCKS[network.trunk.name]}
    for count, layer in enumerate(network.features, 1):
        maps = layer(maps)
        if count in ends:
            yield ends[count], maps

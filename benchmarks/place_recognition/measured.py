# SPDX-License-Identifier: Apache-2.0
"""What contenders achieve on images that no training has seen, kept between calls."""

import hashlib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.place_recognition.trainings import (
    LOSSES,
    SEEDS,
    TRUNK_PLANS,
    compared_name,
    planned_trainings,
)
from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset, open_dataset
from placerec.evaluation.embeddings import embed_dataset
from placerec.evaluation.precision_recall import best_match_curve, compare, pair_curve, recall_at
from placerec.files import write_atomically
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


DESK, CORRIDOR, FLOORS, RENDERED = "fr1_desk", "corridor", "ie_tower test floors", "rendered rooms"
DEFAULT = "shipped default"


class EvaluationSet(NamedTuple):
    """Datasets whose figures are averaged."""

    name: str
    datasets: tuple[PlaceDataset, ...]


class Score(NamedTuple):
    """The figures of one contender on one set.

    Attributes:
        average_precision: over all pairs.
        recall_at_1: of the queries with a revisit, those whose best match is one.
        recall_at_full_precision, best_match_area: of the curve of best matches.
    """

    average_precision: float
    recall_at_1: float
    recall_at_full_precision: float
    best_match_area: float


@dataclass(frozen=True)
class Measured:
    """A contender on all sets: scores by set, (Q, R) similarities by dataset."""

    scores: Mapping[str, Score]
    similarities: Mapping[str, Similarities]


@dataclass(frozen=True)
class Results:
    """What was measured, by contender; a training that is not done is not in it.

    Attributes:
        sets: what it was measured on.
        found: by contender.
        layers: by trunk, the names of its untrained layers.
    """

    sets: Sequence[EvaluationSet]
    found: dict[str, Measured]
    layers: dict[str, list[str]]

    def values(self, names: Sequence[str], on: str, figure: str) -> list[float]:
        """Return one figure of each contender, of those that there are."""
        scores = [self.found[name].scores[on] for name in names if name in self.found]
        return [float(getattr(score, figure)) for score in scores]

    def precisions(self, names: Sequence[str], on: str) -> list[float]:
        """Return the average precision of each contender, of those that there are."""
        return self.values(names, on, "average_precision")

    def seeds(self, group: str, loss: str) -> list[str]:
        """Return the trainings of one group with one loss, only seeds that both losses have."""
        names = {seed: [compared_name(group, each, seed) for each in LOSSES] for seed in SEEDS}
        both = [seed for seed in SEEDS if all(name in self.found for name in names[seed])]
        return [compared_name(group, loss, seed) for seed in both]

    def best_layer(self, trunk: str, on: str = DESK) -> str:
        """Return the untrained layer with the largest average precision."""
        return max(self.layers[trunk], key=lambda name: self.precisions([name], on))


def collect(
    data: Path, validation: Path, trunk_weights: Path, runs: Path, default: Path
) -> Results:
    """Measure all that there is; without rendered paths, all but on them.

    Raises:
        RecognizerError: weights or images cannot be read, or a file cannot be written.
    """
    sets = _open_sets(data, validation)
    files = {DEFAULT: default} | {each.name: each.weights(runs) for each in planned_trainings()}
    contenders = [gradients()]
    for name, weights in files.items():
        if weights.exists():
            contenders.append(learned(name, weights))
        else:
            print(f"left out, there are no weights of it yet: {name}")
    found = _measure_all(contenders, sets, runs / "measured")
    layers = {}
    for trunk in TRUNK_PLANS:
        untrained = untrained_layers(trunk, trunk_weights)
        found |= _measure_all(untrained, sets, runs / "measured")
        layers[trunk] = [each.name for each in untrained]
    return Results(sets, found, layers)


def _open_sets(data: Path, validation: Path) -> list[EvaluationSet]:
    sources = {
        DESK: [str(data / "rgbd_dataset_freiburg1_desk")],
        CORRIDOR: [str(data / "corridor")],
        FLOORS: [f"{data / 'ie_tower'}:test"],
        RENDERED: sorted(str(path.parent) for path in validation.glob("*/rgb.txt")),
    }
    return [
        EvaluationSet(name, tuple(open_dataset(source) for source in folders))
        for name, folders in sources.items()
        if folders
    ]


def _measure_all(
    contenders: Sequence[Contender], sets: Sequence[EvaluationSet], folder: Path
) -> dict[str, Measured]:
    found: dict[str, dict[str, Similarities]] = {each.name: {} for each in contenders}
    # Set by set: layers of one network are then worked out in one pass.
    for dataset in (dataset for each in sets for dataset in each.datasets):
        for contender in contenders:
            found[contender.name][dataset.name] = _similarities(contender, dataset, folder)
    return {
        name: Measured({each.name: _mean_score(values, each) for each in sets}, values)
        for name, values in found.items()
    }


def _mean_score(similarities: Mapping[str, Similarities], each: EvaluationSet) -> Score:
    scores = [_score(similarities[dataset.name], dataset) for dataset in each.datasets]
    return Score(*map(float, np.mean(scores, axis=0)))


def _score(similarities: Similarities, dataset: PlaceDataset) -> Score:
    best = best_match_curve(similarities, dataset)
    return Score(
        average_precision=pair_curve(similarities, dataset).area,
        recall_at_1=recall_at(1, similarities, dataset),
        recall_at_full_precision=best.recall_at_full_precision,
        best_match_area=best.area,
    )


def _similarities(contender: Contender, dataset: PlaceDataset, folder: Path) -> Similarities:
    images = [(path.name, path.stat().st_size) for path in dataset.paths]
    facts = repr((contender.name, contender.fingerprint, dataset.name, images))
    path = folder / f"{hashlib.sha256(facts.encode()).hexdigest()[:24]}.npy"
    if path.exists():
        kept: Similarities = np.load(path, allow_pickle=False)
        return kept
    print(f"{contender.name} on {dataset.name}", flush=True)
    similarities = compare(contender.embed(dataset), dataset)
    buffer = io.BytesIO()
    np.save(buffer, similarities)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, buffer.getvalue())
    return similarities

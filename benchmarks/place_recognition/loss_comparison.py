# SPDX-License-Identifier: Apache-2.0
"""Is it the loss or the choice of images? The paper's comparison, taken apart.

    python -m benchmarks.place_recognition.loss_comparison SCENES PATHS fr1_desk corridor \
        --mobilenet mobilenet_v2.npz --work FOLDER

The paper's conditions: a random fully connected layer of 1,000 values behind flattened maps, its
margins, five sets a step, a learning rate of 1e-4. The maps are those of MobileNetV2's ImageNet
weights and stay as they are, so that a training takes minutes and five seeds of each can be had.
Three ways to learn start from the same layer, and the first two see the same images in every round:

- *multi-constraint*: eq. 7 on the sets of Algorithm 1;
- *triplet, same sets*: eq. 2 on the sets of Algorithm 1;
- *triplet, drawn*: eq. 2 on as many images drawn at random, as triplets are without mining.

SCENES and PATHS are made by `python -m benchmarks.training_scenes`, PATHS with --paths; what is
measured on is any data that `placerec evaluate` takes, or a folder of such. What was worked out is
kept in FOLDER.
"""

import argparse
import io
import sys
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import t as student
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from benchmarks.place_recognition.trainings import PAPERS_MARGINS
from placerec.datasets import LabelledImages, PlaceDataset, open_collection, open_dataset
from placerec.evaluation.precision_recall import evaluate
from placerec.files import write_atomically
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.pretrained import load_pretrained
from placerec.training.image_sets import (
    ImageSets,
    SetRules,
    build_image_sets,
    one_of_each,
    sample_scenes,
)
from placerec.training.losses import (
    draw_partners,
    simplified_multi_constraint_loss,
    triplet_loss,
)

SIZE_PX, BLOCK = (160, 120), "block12"
RULES = SetRules()
ALPHA, BETA = PAPERS_MARGINS["alpha"], PAPERS_MARGINS["beta"]
DIMENSION, BATCH_SETS, LEARNING_RATE = 1000, 5, 1e-4
SCENES_PER_ROUND, PLACES_PER_SCENE, IMAGES_PER_PLACE = 3, 12, 4
IMAGES_PER_PASS = 16
OURS, SAME_SETS, DRAWN = "multi-constraint", "triplet, same sets", "triplet, drawn"
WAYS = (OURS, SAME_SETS, DRAWN)

Kinds = dict[str, list[tuple[PlaceDataset, Tensor]]]


def main() -> int:
    """Learn what is not learned yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, help="to learn from")
    parser.add_argument("data", nargs="+", help="to measure on, a kind of scenes each")
    parser.add_argument("--mobilenet", type=Path, required=True, help="its ImageNet weights")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--most-scenes", type=int, default=60)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    trunk = PlaceNetwork(TRUNKS["mobilenet_v2"], 1, block=BLOCK, size_px=SIZE_PX)
    load_pretrained(trunk, options.mobilenet)
    trunk.eval()
    folders = sorted(path.parent for path in options.scenes.glob("*/rgb.txt"))
    chosen = folders[:: max(1, len(folders) // options.most_scenes)]
    datasets = [open_dataset(str(folder), "train") for folder in chosen]
    values = torch.cat(
        [_values(trunk, each, f"learn-{each.name}", options.work) for each in datasets]
    )
    kinds: Kinds = {}
    for source in options.data:
        kind = Path(source).name
        kinds[kind] = [
            (each, _values(trunk, each, f"{kind}-{each.name}", options.work))
            for each in open_collection(source)
        ]
    images, found = LabelledImages(datasets), {}
    for seed in range(options.seeds):
        for way in WAYS:
            file = options.work / f"{way.replace(', ', '-')}-seed{seed}-{options.steps}.npy"
            if not file.exists():
                curve = list(_learn(images, values, kinds, way, seed, options.steps))
                _keep(file, np.array(curve))
            found[way, seed] = np.load(file)
    _print(list(kinds), found, range(options.seeds))
    return 0


@torch.no_grad()
def _values(trunk: PlaceNetwork, dataset: PlaceDataset, name: str, work: Path) -> Tensor:
    """Return the (N, F) float16 flattened maps of a dataset's images, kept by a name."""
    file = work / f"{name}.npy"
    if not file.exists():
        parts = []
        for start in tqdm(range(0, len(dataset), IMAGES_PER_PASS), desc=name, leave=False):
            end = min(start + IMAGES_PER_PASS, len(dataset))
            parts.append(trunk.features(trunk.prepare([dataset[i] for i in range(start, end)])))
        _keep(file, torch.cat(parts).flatten(start_dim=1).half().numpy())
    return torch.from_numpy(np.load(file))


def _keep(file: Path, values: NDArray[Any]) -> None:
    buffer = io.BytesIO()
    np.save(buffer, values)
    write_atomically(file, buffer.getvalue())


def _learn(
    images: LabelledImages, values: Tensor, kinds: Kinds, way: str, seed: int, steps: int
) -> Iterator[list[float]]:
    """Yield the average precision on each kind before the first step, and ten times on the way."""
    torch.manual_seed(seed)
    layer = torch.nn.Linear(values.shape[1], DIMENSION)
    adam = torch.optim.Adam(layer.parameters(), lr=LEARNING_RATE)
    rounds = _rounds(images, values, layer, way, seed)
    yield _precisions(layer, kinds)
    for step in tqdm(range(1, steps + 1), desc=f"{way}, seed {seed}"):
        sets = next(rounds)
        rows = np.concatenate([sets.positives, sets.negatives], axis=1)
        embeddings = _embed(layer, values[torch.from_numpy(rows.ravel())])
        embeddings = embeddings.reshape(*rows.shape, DIMENSION)
        positives, negatives = embeddings[:, : RULES.positives], embeddings[:, RULES.positives :]
        if way == OURS:
            rng = np.random.default_rng([seed, step])
            partners = torch.from_numpy(draw_partners(len(sets), RULES.negatives, rng))
            losses = simplified_multi_constraint_loss(positives, negatives, partners, ALPHA, BETA)
        else:
            shown = torch.from_numpy(sets.positives)
            is_pair = shown[:, :, None] != shown[:, None, :]
            losses = triplet_loss(positives, negatives, is_pair, ALPHA)
        adam.zero_grad()
        torch.autograd.backward(losses.mean())
        adam.step()
        if step % max(1, steps // 10) == 0:
            yield _precisions(layer, kinds)


def _rounds(
    images: LabelledImages, values: Tensor, layer: torch.nn.Linear, way: str, seed: int
) -> Iterator[ImageSets]:
    """Yield five sets at a time, of images that are drawn alike for all ways."""
    for number in count():
        rng = np.random.default_rng([seed, number])
        draw = (SCENES_PER_ROUND, PLACES_PER_SCENE, rng)
        visited = sample_scenes(images.scenes, images.places, images.collections, *draw)
        anchors = visited[one_of_each(images.places[visited], rng)]
        seen = images.around(anchors, IMAGES_PER_PLACE, RULES.neighbours, rng)
        truth, rows = images.pairs(seen), np.searchsorted(seen, rng.permutation(anchors))
        if way == DRAWN:
            sets = _drawn(truth.same, truth.apart, rows, rng)
        else:
            with torch.no_grad():
                features = _embed(layer, values[torch.from_numpy(seen)]).numpy()
            sets = build_image_sets(features, truth, rng, RULES, rows)
        for start in range(0, len(sets), BATCH_SETS):
            part = slice(start, start + BATCH_SETS)
            yield ImageSets(seen[sets.positives[part]], seen[sets.negatives[part]])


def _drawn(
    same: NDArray[np.bool_],
    apart: NDArray[np.bool_],
    anchors: NDArray[np.int64],
    rng: np.random.Generator,
) -> ImageSets:
    """Return a set for each anchor, of any images of its place and of others."""
    positives, negatives = [], []
    for anchor in anchors.tolist():
        own = rng.permutation(np.flatnonzero(same[anchor]))[: RULES.positives]
        own = np.concatenate([own, rng.choice(own, RULES.positives - len(own))])
        positives.append(own)
        others = np.flatnonzero(apart[own].all(axis=0))
        negatives.append(rng.choice(others, RULES.negatives, replace=False))
    return ImageSets(np.array(positives), np.array(negatives))


def _embed(layer: torch.nn.Linear, values: Tensor) -> Tensor:
    return functional.normalize(layer(values.float()))


@torch.no_grad()
def _precisions(layer: torch.nn.Linear, kinds: Kinds) -> list[float]:
    return [
        fmean(
            evaluate(each, _embed(layer, values).numpy()).pair_curve.area for each, values in kind
        )
        for kind in kinds.values()
    ]


def _print(
    kinds: Sequence[str], found: dict[tuple[str, int], NDArray[np.float64]], seeds: Sequence[int]
) -> None:
    print("| average precision | start | " + " | ".join(WAYS) + " | over same sets | over drawn |")
    print("|---|---:|" + "---:|" * len(WAYS) + "---|---|")
    for k, kind in enumerate(kinds):
        ends = {way: np.array([found[way, seed][-1, k] for seed in seeds]) for way in WAYS}
        start = fmean(found[OURS, seed][0, k] for seed in seeds)
        cells = [f"{start:.3f}", *(f"{ends[way].mean():.3f}" for way in WAYS)]
        cells += [_gain(ends[OURS], ends[other]) for other in (SAME_SETS, DRAWN)]
        print(f"| {kind} | " + " | ".join(cells) + " |")


def _gain(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> str:
    """Return the mean gain over paired seeds, and its 95 % interval by Student's t."""
    gains = 100.0 * (ours / theirs - 1.0)
    if len(gains) < 2:
        return f"{gains.mean():+.1f} %"
    half = student.ppf(0.975, len(gains) - 1) * gains.std(ddof=1) / len(gains) ** 0.5
    return f"{gains.mean():+.1f} % ({gains.mean() - half:+.1f} to {gains.mean() + half:+.1f})"


if __name__ == "__main__":
    sys.exit(main())

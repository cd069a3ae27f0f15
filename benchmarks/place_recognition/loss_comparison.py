# SPDX-License-Identifier: Apache-2.0
"""Is it the loss or the choice of images? The paper's comparison, taken apart.

    python -m benchmarks.place_recognition.loss_comparison SCENES PATHS fr1_desk corridor \
        --mobilenet mobilenet_v2.npz --work FOLDER [--frozen-block block9] [--same-sets-only]

The paper's conditions: a random fully connected layer of 1,000 values behind flattened maps, its
margins, five sets a step. It names no learning rate: ours is 1e-4. The maps are those of
MobileNetV2's ImageNet weights. They stay as they are, so that a training takes minutes and five
seeds of each can be had; or the blocks behind --frozen-block learn as well, at the same rate. (The
weights have the batch norms folded in: there is none to train or to freeze.) Three ways to learn
start from the same weights, and the first two see the same images in every round:

- *multi-constraint*: eq. 7 on the sets of Algorithm 1;
- *triplet, same sets*: eq. 2 on the sets of Algorithm 1;
- *triplet, drawn*: eq. 2 on as many images drawn at random, as triplets are without mining.

Of several rates, each way learns at the one by which it ends highest on the first of the data, so
that none is held back by a rate that suits another; what that first one then shows is no evidence.

SCENES and PATHS are made by `python -m benchmarks.training_scenes`, PATHS with --paths. Either can
be any data that `placerec evaluate` takes, or a folder of such; clips are learned from by their
training part. What was worked out is kept in FOLDER: other data need another one.
"""

import argparse
import copy
import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import t as student
from torch import Tensor, nn
from torch.nn import functional
from tqdm import tqdm

from benchmarks.place_recognition.trainings import PAPERS_MARGINS
from placerec.datasets import LabelledImages, PlaceDataset, open_collection
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

TRUNK, SIZE_PX, BLOCK = TRUNKS["mobilenet_v2"], (160, 120), "block12"
RULES = SetRules()
ALPHA, BETA = PAPERS_MARGINS["alpha"], PAPERS_MARGINS["beta"]
DIMENSION, BATCH_SETS, LEARNING_RATE = 1000, 5, 1e-4
LOOKS = 4
"""How often a training is measured after its start."""
SCENES_PER_ROUND, PLACES_PER_SCENE, IMAGES_PER_PLACE = 3, 12, 4
IMAGES_PER_PASS = 16
IN_VAIN = 50
"""Rounds without a set after which none is to be expected any more."""
OURS, SAME_SETS, DRAWN = "multi-constraint", "triplet, same sets", "triplet, drawn"
WAYS = (OURS, SAME_SETS, DRAWN)

Kinds = dict[str, list[tuple[PlaceDataset, Tensor]]]
Curves = dict[tuple[str, int], NDArray[np.float64]]
"""For a way and a seed, the (1 + LOOKS, K) average precisions on K kinds."""
CurvesByRate = dict[tuple[float, int], NDArray[np.float64]]
"""The same of one way, for a learning rate and a seed."""


@dataclass(frozen=True)
class Conditions:
    """What is the same for all ways, rates and seeds.

    Attributes:
        images: to learn from.
        maps: (N, C, h, w) float16, theirs.
        kinds: to measure on.
        blocks: those that learn, as they are before the first step.
        steps: after which a training ends.
    """

    images: LabelledImages
    maps: Tensor
    kinds: Kinds
    blocks: nn.Sequential
    steps: int


def main() -> int:
    """Learn what is not learned yet, and print the tables."""
    options = _arguments()
    kept = options.work / options.frozen_block
    kept.mkdir(parents=True, exist_ok=True)
    frozen = PlaceNetwork(TRUNK, 1, block=options.frozen_block, size_px=SIZE_PX)
    load_pretrained(frozen, options.mobilenet)
    frozen.eval()
    scenes = open_collection(options.scenes, "train")
    datasets = scenes[:: max(1, len(scenes) // options.most_scenes)]
    maps = torch.cat([_maps(frozen, each, f"learn-{each.name}", kept) for each in datasets])
    kinds: Kinds = {}
    for source in options.data:
        kind = Path(source).name
        kinds[kind] = [
            (each, _maps(frozen, each, f"{kind}-{each.name}", kept))
            for each in open_collection(source)
        ]
    blocks = _blocks_behind(options.frozen_block, options.mobilenet)
    same = Conditions(LabelledImages(datasets), maps, kinds, blocks, options.steps)
    ways = WAYS[:2] if options.same_sets_only else WAYS
    found, rate_of, seeds = Curves(), dict[str, float](), range(options.seeds)
    for way in ways:
        by_rate = _learned(same, way, options.learning_rate, seeds, kept)
        rate_of[way] = _best_rate(by_rate, seeds)
        found |= {(way, seed): by_rate[rate_of[way], seed] for seed in seeds}
    _print_gains(list(kinds), found, ways, seeds)
    _print_curves(list(kinds), found, ways, seeds, options.steps)
    if len(options.learning_rate) > 1:
        told = (f"{way} {rate:g}" for way, rate in rate_of.items())
        print(f"\nRates, chosen on {next(iter(kinds))}: {'; '.join(told)}")
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", help="to learn from")
    parser.add_argument("data", nargs="+", help="to measure on, a kind of scenes each")
    parser.add_argument("--mobilenet", type=Path, required=True, help="its ImageNet weights")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--most-scenes", type=int, default=60)
    blocks = list(TRUNK.blocks)[: list(TRUNK.blocks).index(BLOCK) + 1]
    parser.add_argument("--frozen-block", choices=blocks, default=BLOCK, metavar="BLOCK")
    parser.add_argument("--learning-rate", type=float, nargs="+", default=[LEARNING_RATE])
    parser.add_argument("--same-sets-only", action="store_true", help="leave the drawn ones out")
    return parser.parse_args()


def _learned(
    same: Conditions, way: str, rates: Sequence[float], seeds: Sequence[int], kept: Path
) -> CurvesByRate:
    """Return how one way learns at all rates and seeds; what is not in the folder is learned."""
    found = CurvesByRate()
    for rate, seed in product(rates, seeds):
        name = f"{way.replace(', ', '-')}-seed{seed}-{same.steps}-{rate:g}"
        file = kept / f"{name}-{'+'.join(same.kinds)}.npy"  # whose columns these are
        if not file.exists():
            _keep(file, np.array(list(_learn(same, way, rate, seed))))
        found[rate, seed] = np.load(file)
    return found


def _best_rate(by_rate: CurvesByRate, seeds: Sequence[int]) -> float:
    """Return the rate by which the mean of all seeds ends highest on the first kind."""
    rates = dict.fromkeys(rate for rate, _ in by_rate)
    return max(rates, key=lambda rate: fmean(by_rate[rate, seed][-1, 0] for seed in seeds))


def _blocks_behind(frozen_block: str, mobilenet: Path) -> nn.Sequential:
    """Return the trunk's blocks from the one behind a frozen one to `BLOCK`."""
    whole = PlaceNetwork(TRUNK, 1, block=BLOCK, size_px=SIZE_PX)
    load_pretrained(whole, mobilenet)
    return nn.Sequential(*list(whole.features.children())[TRUNK.layer_count(frozen_block) :])


@torch.no_grad()
def _maps(frozen: PlaceNetwork, dataset: PlaceDataset, name: str, kept: Path) -> Tensor:
    """Return the (N, C, h, w) float16 maps of a dataset's images, kept by a name."""
    file = kept / f"{name}.npy"
    if not file.exists():
        parts = []
        for start in tqdm(range(0, len(dataset), IMAGES_PER_PASS), desc=name, leave=False):
            end = min(start + IMAGES_PER_PASS, len(dataset))
            parts.append(frozen.features(frozen.prepare([dataset[i] for i in range(start, end)])))
        _keep(file, torch.cat(parts).half().numpy())
    return torch.from_numpy(np.load(file))


def _keep(file: Path, values: NDArray[Any]) -> None:
    buffer = io.BytesIO()
    np.save(buffer, values)
    write_atomically(file, buffer.getvalue())


def _learn(same: Conditions, way: str, rate: float, seed: int) -> Iterator[list[float]]:
    """Yield the average precision on each kind before the first step, and LOOKS times after it."""
    maps, kinds = same.maps, same.kinds
    torch.manual_seed(seed)
    blocks = copy.deepcopy(same.blocks)
    layer = nn.Linear(blocks(maps[:1].float()).numel(), DIMENSION)
    network = nn.Sequential(blocks, nn.Flatten(), layer)
    adam = torch.optim.Adam(network.parameters(), lr=rate)
    rounds = _rounds(same.images, maps, network, way, seed)
    yield _precisions(network, kinds)
    for step in tqdm(range(1, same.steps + 1), desc=f"{way}, seed {seed}"):
        sets = next(rounds)
        rows = np.concatenate([sets.positives, sets.negatives], axis=1)
        different, which = np.unique(rows, return_inverse=True)  # sets share images
        embeddings = _embed(network, maps[torch.from_numpy(different)])[which.reshape(rows.shape)]
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
        if step in _looks(same.steps):
            yield _precisions(network, kinds)


def _looks(steps: int) -> list[int]:
    """Return the steps after which a training is measured."""
    return [steps * look // LOOKS for look in range(1, LOOKS + 1)]


def _rounds(
    images: LabelledImages, maps: Tensor, network: nn.Module, way: str, seed: int
) -> Iterator[ImageSets]:
    """Yield five sets at a time, of images that are drawn alike for all ways."""
    without_a_set = 0
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
                features = _embed(network, maps[torch.from_numpy(seen)]).numpy()
            sets = build_image_sets(features, truth, rng, RULES, rows)
        without_a_set = 0 if len(sets) else without_a_set + 1
        if without_a_set == IN_VAIN:
            sys.exit(
                f"error: {way}, seed {seed}: no set can be built any more, as the places are told"
                " apart, or thrown about; take a lower --learning-rate or fewer --steps"
            )
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


def _embed(network: nn.Module, maps: Tensor) -> Tensor:
    # In the order of numbers in memory that convolutions on a CPU are faster with.
    inputs = maps.float().contiguous(memory_format=torch.channels_last)
    return functional.normalize(network(inputs))


@torch.no_grad()
def _precisions(network: nn.Module, kinds: Kinds) -> list[float]:
    return [
        fmean(evaluate(each, _embed(network, maps).numpy()).pair_curve.area for each, maps in kind)
        for kind in kinds.values()
    ]


def _print_gains(
    kinds: Sequence[str], found: Curves, ways: Sequence[str], seeds: Sequence[int]
) -> None:
    others = [way for way in ways if way != OURS]
    columns = ["start", *ways, *(f"over {way}" for way in others)]
    print("| average precision at the end | " + " | ".join(columns) + " |")
    print("|---|" + "---:|" * (1 + len(ways)) + "---|" * len(others))
    for k, kind in enumerate(kinds):
        ends = {way: np.array([found[way, seed][-1, k] for seed in seeds]) for way in ways}
        start = fmean(found[OURS, seed][0, k] for seed in seeds)
        cells = [f"{start:.3f}", *(f"{ends[way].mean():.3f}" for way in ways)]
        cells += [_gain(ends[OURS], ends[other]) for other in others]
        print(f"| {kind} | " + " | ".join(cells) + " |")


def _print_curves(
    kinds: Sequence[str], found: Curves, ways: Sequence[str], seeds: Sequence[int], steps: int
) -> None:
    print(
        "\n| average precision after steps | | " + " | ".join(map(str, [0, *_looks(steps)])) + " |"
    )
    print("|---|---|" + "---:|" * (1 + LOOKS))
    for k, kind in enumerate(kinds):
        for way in ways:
            means = np.mean([found[way, seed][:, k] for seed in seeds], axis=0)
            print(f"| {kind} | {way} | " + " | ".join(f"{mean:.3f}" for mean in means) + " |")


def _gain(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> str:
    """Return the mean gain over paired seeds, and its 95 % interval by Student's t."""
    gains = 100.0 * (ours / theirs - 1.0)
    if len(gains) < 2:
        return f"{gains.mean():+.1f} %"
    half = student.ppf(0.975, len(gains) - 1) * gains.std(ddof=1) / len(gains) ** 0.5
    return f"{gains.mean():+.1f} % ({gains.mean() - half:+.1f} to {gains.mean() + half:+.1f})"


if __name__ == "__main__":
    sys.exit(main())

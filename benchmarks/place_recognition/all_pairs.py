# SPDX-License-Identifier: Apache-2.0
"""Are the rendered scenes used up? The last layer learns the order of all pairs of training images.

    python -m benchmarks.place_recognition.all_pairs SCENES ie_tower ie_tower:validation PATHS...

The shipped trunk stays as it is; the last layer starts from whitened components. A step takes some
places of ten scenes, a fifth of them floors, with what is just beyond each, and raises the smoothed
average precision over all pairs of a scene and of all scenes: what is measured in the end, without
any choice of sets or margins. Printed on the way: the average precision on scenes that are learned
from, and on each kind of validation images.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from placerec.datasets import LabelledImages, PlaceDataset, open_collection
from placerec.evaluation.precision_recall import evaluate
from placerec.networks import PlaceNetwork
from placerec.networks.weights_file import load_weights
from placerec.networks.whitening import whiten
from placerec.training.images import Augmentation

VIEWS = 2
"""An image as it is, and changed."""
SCENES_A_STEP, ANCHORS, OF_PLACE, JUST_BEYOND = 10, 4, 6, 4
FLOORS = 0.2
TEMPERATURE, RATE, WARM_UP = 0.03, 1e-3, 30
LOOKED_AT = 10
"""Training scenes that are measured on."""


def main() -> int:
    """Learn, and print what it brings."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes")
    parser.add_argument("floors")
    parser.add_argument("data", nargs="+", help="to measure on, a kind of scenes each")
    parser.add_argument(
        "--weights", type=Path, default=Path("placerec/weights/default.safetensors")
    )
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--looks", type=int, default=5)
    options = parser.parse_args()
    network = load_weights(options.weights)[0].eval()
    scenes = open_collection(options.scenes, "train")
    torch.set_num_threads(2)
    images = LabelledImages(scenes, open_collection(options.floors, "train"))
    views = [_values(network, images, range(len(images)), changed) for changed in range(VIEWS)]
    rng = np.random.default_rng(0)
    of_each = [np.flatnonzero(images.collections == k) for k in range(2)]
    shown = np.concatenate([rng.choice(own, min(1000, len(own)), False) for own in of_each])
    whiten(network, views[0][torch.from_numpy(shown)].float())
    learned = scenes[:: max(1, len(scenes) // LOOKED_AT)]
    kinds = {"learned from": [(each, _of(network, each)) for each in learned]}
    for source in options.data:
        kinds[Path(source).name] = [(e, _of(network, e)) for e in open_collection(source)]
    print("| steps | " + " | ".join(kinds) + " |\n|---|" + "---:|" * len(kinds))
    _print(0, network, kinds)
    layer = network.fully_connected
    adam = torch.optim.Adam(layer.parameters())
    for step in tqdm(range(1, options.steps + 1)):
        share = 0.5 * (1.0 + np.cos(np.pi * step / options.steps)) * min(1.0, step / WARM_UP)
        adam.param_groups[0]["lr"] = RATE * share
        seen = _drawn(images, rng)
        truth, scene = images.pairs(seen), images.scenes[seen]
        values = torch.stack([views[rng.integers(VIEWS)][i] for i in seen.tolist()]).float()
        embeddings = functional.normalize(layer(values))
        alike = embeddings @ embeddings.T
        within = []
        for k in np.unique(scene):
            own = np.ix_(*[np.flatnonzero(scene == k)] * 2)
            within.append(_loss(alike[own], truth.same[own], truth.apart[own]))
        told = [each for each in within if each is not None]
        overall = _loss(alike, truth.same, truth.apart)
        assert overall is not None and told
        adam.zero_grad()
        torch.autograd.backward(0.5 * torch.stack(told).mean() + 0.5 * overall)
        torch.nn.utils.clip_grad_norm_(layer.parameters(), 2.0)
        adam.step()
        if step % max(1, options.steps // options.looks) == 0:
            _print(step, network, kinds)
    return 0


@torch.no_grad()
def _values(
    network: PlaceNetwork,
    images: LabelledImages | PlaceDataset,
    which: Sequence[int],
    is_changed: int = 0,
) -> Tensor:
    """Return the (N, F) float16 values that the last layer sees."""
    change, parts = Augmentation(), []
    for start in tqdm(range(0, len(which), 16), leave=False):
        some = [images[i] for i in which[start : start + 16]]
        if is_changed:
            rngs = [np.random.default_rng([is_changed, start, k]) for k in range(len(some))]
            some = [change(image, rng) for image, rng in zip(some, rngs, strict=True)]
        parts.append(network.flatten(network.features(network.prepare(some))).half())
    return torch.cat(parts)


def _of(network: PlaceNetwork, dataset: PlaceDataset) -> Tensor:
    return _values(network, dataset, range(len(dataset)))


def _drawn(images: LabelledImages, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return images of some places of some scenes, and from just beyond."""
    drawn = []
    for _ in range(SCENES_A_STEP):
        kind = int(rng.random() < FLOORS)
        scene = rng.choice(np.unique(images.scenes[images.collections == kind]))
        own = np.flatnonzero(images.scenes == scene)
        anchors = rng.choice(own, min(len(own), 3 * ANCHORS if kind else ANCHORS), replace=False)
        drawn.append(images.around(anchors, 3 if kind else OF_PLACE, JUST_BEYOND, rng))
    return np.unique(np.concatenate(drawn))


def _loss(alike: Tensor, same: NDArray[np.bool_], apart: NDArray[np.bool_]) -> Tensor | None:
    """Return 1 less the average precision over all pairs, with a soft order."""
    once = np.triu_indices(len(same), 1)
    pairs = alike[once]
    right, wrong = pairs[torch.from_numpy(same[once])], pairs[torch.from_numpy(apart[once])]
    if len(right) < 2 or len(wrong) < 2:
        return None
    wrong = wrong.topk(min(4000, len(wrong))).values
    above = torch.sigmoid((right - right[:, None]) / TEMPERATURE).sum(dim=1) + 0.5
    wrong_above = torch.sigmoid((wrong - right[:, None]) / TEMPERATURE).sum(dim=1)
    return 1.0 - (above / (above + wrong_above)).mean()


@torch.no_grad()
def _print(
    step: int, network: PlaceNetwork, kinds: dict[str, list[tuple[PlaceDataset, Tensor]]]
) -> None:
    cells = []
    for kind in kinds.values():
        areas = []
        for dataset, values in kind:
            embeddings = functional.normalize(network.fully_connected(values.float())).numpy()
            areas.append(evaluate(dataset, embeddings).pair_curve.area)
        cells.append(f"{fmean(areas):.3f}")
    print(f"| {step} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""The trainings that are compared: what each is, and how it is done, once and for all."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

from placerec.datasets import LabelledImages, PlaceDataset, open_dataset
from placerec.networks.weights_file import save_weights
from placerec.networks.whitening import merge
from placerec.training.config import TrainingConfig
from placerec.training.run import WEIGHTS_NAME, start_training, write_results
from placerec.training.workers import Workers

RECIPE = TrainingConfig(
    covariance=True,
    dimension=512,
    alpha=1.0,
    beta=0.6,
    gamma_prime=1.3,
    scenes_per_round=3,
    places_per_scene=12,
    images_per_place=4,
    batch_sets=40,
    learning_rate=1e-3,
    trunk_learning_rate=1.5e-4,
    augment=True,
    mixed_precision=True,
)
MOBILENET = Path("mobilenet_v2/mobilenet_v2.npz")
SQUEEZENET = Path("squeezenet_v1.0/squeezenet_v1.0.npz")
"""Published weights, below the folder of trunk weights; the other trunks start from scratch."""


def _plan(trunk: str, **changes: Any) -> TrainingConfig:
    return replace(RECIPE, trunk=trunk, **changes)


TRUNK_PLANS = {
    "mobilenet_v2": _plan(
        "mobilenet_v2", weights=MOBILENET, block="block12", size=(160, 120), steps=120
    ),
    "squeezenet": _plan("squeezenet", weights=SQUEEZENET, block="fire5", size=(160, 120), steps=60),
    "alexnet": _plan("alexnet", block="conv5", size=(160, 120), steps=60),
    "vgg16": _plan("vgg16", block="conv3_3", size=(96, 72), steps=15),
}
LOSSES = ("multi-constraint", "triplet")
SEEDS = (0, 1, 2)
DIMENSIONS = (4096, 1000)
"""Beside the recipe's own."""
MAIN_TRUNK = "mobilenet_v2"
"""What the experiments are made with."""
PAPERS_MARGINS: dict[str, Any] = {"alpha": 0.5, "beta": 0.3, "gamma_prime": 0.4}
PAPERS_CONDITIONS: dict[str, Any] = {
    "covariance": False,
    "random_last_layer": True,
    "dimension": 1000,
    **PAPERS_MARGINS,
}
"""Flattened maps, a fully connected layer from random weights, and the paper's margins."""
PAPERS = "papers-conditions"
XYZ = "rgbd_dataset_freiburg1_xyz"


@dataclass(frozen=True)
class PlannedTraining:
    """A training with a name; its plan's weights are a path below the folder of trunk weights.

    Attributes:
        name: unique among the planned.
        plan: what is trained, and how.
        with_xyz: whether it learns from fr1_xyz, too.
        is_start: it ends before its first step.
    """

    name: str
    plan: TrainingConfig
    with_xyz: bool = False
    is_start: bool = False

    def folder(self, runs: Path) -> Path:
        """Return where its files are; another plan of the same name has another folder."""
        facts = repr((self.plan, self.with_xyz, self.is_start))
        return runs / f"{self.name}-{hashlib.sha256(facts.encode()).hexdigest()[:8]}"

    def weights(self, runs: Path) -> Path:
        """Return the file that is there when it is done."""
        return self.folder(runs) / WEIGHTS_NAME


def compared_name(group: str, loss: str, seed: int) -> str:
    """Return what a training is called that compares losses: of a trunk, or of `PAPERS`."""
    return f"{group}-{loss}-seed{seed}"


def planned_trainings() -> list[PlannedTraining]:
    """Return all trainings, the most important ones first."""
    main = TRUNK_PLANS[MAIN_TRUNK]
    groups = {**TRUNK_PLANS, PAPERS: replace(main, **PAPERS_CONDITIONS)}
    compared = {
        group: [
            PlannedTraining(compared_name(group, loss, seed), replace(plan, loss=loss, seed=seed))
            for seed in SEEDS
            for loss in LOSSES
        ]
        for group, plan in groups.items()
    }
    experiments = [
        *(PlannedTraining(f"dimension-{d}", replace(main, dimension=d)) for d in DIMENSIONS),
        PlannedTraining("with-fr1_xyz", main, with_xyz=True),
        PlannedTraining("papers-margins", replace(main, **PAPERS_MARGINS)),
        PlannedTraining("papers-pooling", replace(main, covariance=False)),
    ]
    starts = [
        PlannedTraining(f"{name}-start", plan, is_start=True) for name, plan in groups.items()
    ]
    first, papers = compared.pop(MAIN_TRUNK), compared.pop(PAPERS)
    return [*first, *experiments, *papers, *starts, *chain(*compared.values())]


def train(
    planned: Sequence[PlannedTraining], data: Path, scenes: Path, trunk_weights: Path, runs: Path
) -> None:
    """Do trainings, or go on with them; finished ones are not repeated.

    Raises:
        RecognizerError: a plan or the data cannot be used, or a file cannot be written.
    """

    @cache
    def datasets() -> list[PlaceDataset]:
        rendered = sorted(str(path.parent) for path in scenes.glob("*/rgb.txt"))
        return [open_dataset(source, "train") for source in (*rendered, str(data / "ie_tower"))]

    @cache
    def images(with_xyz: bool) -> LabelledImages:
        xyz = [open_dataset(str(data / XYZ))] if with_xyz else []
        return LabelledImages([*datasets(), *xyz])

    for each in planned:
        print(each.name, flush=True)
        if not each.weights(runs).exists():
            _train(each, images(each.with_xyz), trunk_weights, each.folder(runs))


def _train(
    planned: PlannedTraining, images: LabelledImages, trunk_weights: Path, folder: Path
) -> None:
    plan = planned.plan
    if plan.weights is not None:
        plan = replace(plan, weights=trunk_weights / plan.weights)
    training = start_training(plan, images, folder, Workers(), lambda done, total: None)
    if planned.is_start:
        merge(training.network)
        save_weights(training.network, folder / WEIGHTS_NAME, 0.0)
        return
    for record in training:
        if record.step % 10 == 0:
            minutes = record.time_to_go_s / 60
            print(f"{planned.name}: step {record.step}, {minutes:.1f} min to go", flush=True)
    write_results(training, plan, folder)
    training.checkpoint_path.unlink(missing_ok=True)  # large, and of no use any more

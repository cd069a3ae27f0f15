# SPDX-License-Identifier: Apache-2.0
"""The trainings that are compared: what each is, and how it is done, once and for all."""

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from placerec.datasets import LabelledImages, PlaceDataset, open_dataset
from placerec.networks.weights_file import save_weights
from placerec.networks.whitening import merge
from placerec.training.config import TrainingConfig
from placerec.training.loop import Training
from placerec.training.run import WEIGHTS_NAME, start_training, write_results
from placerec.training.workers import Workers

# ---- The recipe: all that the trainings have in common, and what they differ in. ----

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
TRUNK_PLANS = {
    "mobilenet_v2": replace(RECIPE, block="block12", size=(160, 120), steps=120),
    "squeezenet": replace(RECIPE, trunk="squeezenet", block="fire5", size=(160, 120), steps=60),
    "alexnet": replace(RECIPE, trunk="alexnet", block="conv5", size=(160, 120), steps=60),
    "vgg16": replace(RECIPE, trunk="vgg16", block="conv3_3", size=(96, 72), steps=15),
}
PUBLISHED_WEIGHTS = {
    "mobilenet_v2": Path("mobilenet_v2/mobilenet_v2.npz"),
    "squeezenet": Path("squeezenet_v1.0/squeezenet_v1.0.npz"),
}
"""Of the trunks that do not start from scratch, below the folder of trunk weights."""
LOSSES = ("multi-constraint", "triplet")
SEEDS = (0, 1, 2)
DIMENSIONS = (4096, 1000)
"""Beside the recipe's own."""
MAIN_TRUNK = "mobilenet_v2"
"""What the experiments are made with."""
PAPERS_CONDITIONS = {
    "covariance": False,
    "random_last_layer": True,
    "dimension": 1000,
    "alpha": 0.5,
    "beta": 0.3,
    "gamma_prime": 0.4,
}
"""Flattened maps, a fully connected layer from random weights, and the paper's margins."""
PAPERS_START = "papers-conditions-start"
LATER_SETTINGS = {"random_last_layer": False}
"""What trainings had that were done before there was such a setting: their folders stay theirs."""
XYZ = "rgbd_dataset_freiburg1_xyz"

# ---------------------------------------------------------------------------------------


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
        settings = asdict(self.plan)
        for name, default in LATER_SETTINGS.items():
            if settings[name] == default:
                del settings[name]
        facts = repr((sorted(settings.items()), self.with_xyz, self.is_start))
        return runs / f"{self.name}-{hashlib.sha256(facts.encode()).hexdigest()[:8]}"

    def weights(self, runs: Path) -> Path:
        """Return the file that is there when it is done."""
        return self.folder(runs) / WEIGHTS_NAME


def compared_name(trunk: str, loss: str, seed: int) -> str:
    """Return what a training of the comparison of losses is called."""
    return f"{trunk}-{loss}-seed{seed}"


def papers_name(loss: str, seed: int) -> str:
    """Return what a training under the paper's own conditions is called."""
    return f"papers-conditions-{loss}-seed{seed}"


def planned_trainings() -> list[PlannedTraining]:
    """Return all trainings, the most important ones first."""
    plans = {
        name: replace(plan, weights=PUBLISHED_WEIGHTS.get(name))
        for name, plan in TRUNK_PLANS.items()
    }
    compared = [
        PlannedTraining(compared_name(trunk, loss, seed), replace(plan, loss=loss, seed=seed))
        for trunk, plan in plans.items()
        for seed in SEEDS
        for loss in LOSSES
    ]
    main = plans[MAIN_TRUNK]
    starts = [
        *(PlannedTraining(f"{trunk}-start", plan, is_start=True) for trunk, plan in plans.items()),
        PlannedTraining(PAPERS_START, replace(main, **PAPERS_CONDITIONS), is_start=True),
    ]
    experiments = [
        *(PlannedTraining(f"dimension-{d}", replace(main, dimension=d)) for d in DIMENSIONS),
        PlannedTraining("with-fr1_xyz", main, with_xyz=True),
        PlannedTraining("papers-margins", replace(main, alpha=0.5, beta=0.3, gamma_prime=0.4)),
        PlannedTraining("papers-pooling", replace(main, covariance=False)),
    ]
    papers_all = [
        PlannedTraining(
            papers_name(loss, seed), replace(main, **PAPERS_CONDITIONS, loss=loss, seed=seed)
        )
        for seed in SEEDS
        for loss in LOSSES
    ]
    count = len(SEEDS) * len(LOSSES)
    return [*compared[:count], *experiments, *papers_all, *starts, *compared[count:]]


class Trainer:
    """Does planned trainings; what they learn from is opened when it is first needed."""

    def __init__(self, data: Path, scenes: Path, trunk_weights: Path, runs: Path) -> None:
        self._data, self._trunk_weights, self._runs = data, trunk_weights, runs
        self._scenes = sorted(path.parent for path in scenes.glob("*/rgb.txt"))
        self._datasets: list[PlaceDataset] = []
        self._images: dict[bool, LabelledImages] = {}

    def train(self, planned: PlannedTraining) -> None:
        """Do a training, or go on with it; a finished one is not repeated.

        Raises:
            RecognizerError: the plan or the data cannot be used, or a file cannot be written.
        """
        if planned.weights(self._runs).exists():
            return
        folder, plan = planned.folder(self._runs), planned.plan
        if plan.weights is not None:
            plan = replace(plan, weights=self._trunk_weights / plan.weights)
        training = start_training(
            plan, self._learned_from(planned.with_xyz), folder, Workers(), _ignore
        )
        if planned.is_start:
            merge(training.network)
            save_weights(training.network, planned.weights(self._runs), 0.0)
            return
        _follow(planned.name, training)
        write_results(training, plan, folder)
        training.checkpoint_path.unlink(missing_ok=True)  # large, and of no use any more

    def _learned_from(self, with_xyz: bool) -> LabelledImages:
        if not self._datasets:
            sources = [*map(str, self._scenes), str(self._data / "ie_tower")]
            self._datasets = [open_dataset(source, "train") for source in sources]
        if with_xyz not in self._images:
            xyz = [open_dataset(str(self._data / XYZ))] if with_xyz else []
            self._images[with_xyz] = LabelledImages([*self._datasets, *xyz])
        return self._images[with_xyz]


def share(planned: Iterable[PlannedTraining], part: int, parts: int) -> list[PlannedTraining]:
    """Return the trainings of one of several processes, part 1 to parts."""
    return list(planned)[part - 1 :: parts]


def _follow(name: str, training: Training) -> None:
    for record in training:
        if record.step % 10 == 0:
            minutes = record.time_to_go_s / 60
            print(f"{name}: step {record.step}, {minutes:.1f} min to go", flush=True)


def _ignore(_done: int, _total: int) -> None:
    """Images are looked at."""

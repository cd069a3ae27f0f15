# SPDX-License-Identifier: Apache-2.0
"""A training as planned: from a network's starting weights to the files that it leaves."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import torch
from pydantic import ValidationError
from torch import Tensor

from placerec.certificate import Certificate
from placerec.datasets import LabelledImages
from placerec.errors import RecognizerError
from placerec.files import Progress
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.pooling import Vlad
from placerec.networks.pretrained import load_pretrained
from placerec.networks.weights_file import save_weights
from placerec.networks.whitening import merge, whiten
from placerec.recognizers.learned import LearnedRecognizer
from placerec.training.checkpoint import DIGITS
from placerec.training.config import TrainingConfig, TrainingPlan
from placerec.training.frozen_layers import IMAGES_PER_PASS
from placerec.training.images import Augmentation
from placerec.training.log import read_log, write_plot
from placerec.training.loop import LOG_NAME, Training
from placerec.training.workers import Workers

WEIGHTS_NAME, PLOT_NAME = "weights.safetensors", "log.png"
COMPONENTS_FROM, WORDS_FROM = 2000, 300
"""Images, as many of each collection, that principal components are taken from, and words for
NetVLAD; more cost time and memory."""


def start_training(
    plan: TrainingPlan, images: LabelledImages, folder: Path, workers: Workers, progress: Progress
) -> Training:
    """Return a training as planned, or the one that the folder holds a checkpoint of.

    The trunk starts from the plan's weights, the fully connected layer from the whitened principal
    components of what the trunk makes of the images, or from random weights.

    Args:
        plan: what is asked for.
        images: to learn from.
        folder: for all files; made where it is missing.
        workers: the processes that share the training.
        progress: called while images are looked at.

    Raises:
        RecognizerError: the plan or its weights cannot be used, the checkpoint is damaged or of
            another training, or the folder cannot be written to.
    """
    config, network = _config(plan), _network(plan)
    if plan.weights is not None:
        load_pretrained(network, plan.weights)
    _make(folder)
    _start_last_layers(network, plan, images, workers.device, progress)
    origin = {"start": _hash_file(plan.weights), "names of images": _hash("\n".join(images.names))}
    return Training(
        network, images, config, folder, workers=workers, progress=progress, origin=origin
    )


def write_results(training: Training, plan: TrainingPlan, folder: Path) -> Path:
    """Write the trained weights and the plot of the log, and return the weights' path.

    The fully connected layer is one matrix afterwards; the training cannot go on with it.

    Until it is calibrated, the threshold is the similarity from which the training itself takes
    images of two places for confused: gamma' as a cosine (eq. 9). Weights that come out as those
    that were calibrated here keep what that found.

    Raises:
        RecognizerError: a file cannot be written.
    """
    path = folder / WEIGHTS_NAME
    merge(training.network)
    save_weights(training.network, path, 1.0 - _config(plan).gamma_prime / 2.0)
    if certificate := _certificate_of(path):
        save_weights(training.network, path, certificate.min_similarity)
    write_plot(read_log(folder / LOG_NAME), folder / PLOT_NAME)
    return path


def _certificate_of(weights: Path) -> Certificate | None:
    try:
        return LearnedRecognizer(weights).certificate
    except RecognizerError:  # it is of earlier weights: these have to be calibrated anew
        return None


def _config(plan: TrainingPlan) -> TrainingConfig:
    try:
        return TrainingConfig.model_validate(
            {
                "loss": plan.loss,
                "alpha": plan.alpha,
                "beta": plan.beta,
                "gamma_prime": plan.gamma_prime,
                "batch_sets": plan.batch_sets,
                "images_per_place": plan.images_per_place,
                "scenes_per_round": plan.scenes_per_round,
                "places_per_scene": plan.places_per_scene,
                "mixed_precision": plan.mixed_precision,
                "learning_rate": plan.learning_rate,
                "trunk_learning_rate": plan.trunk_learning_rate,
                "frozen_block": plan.frozen_block,
                "augmentation": Augmentation() if plan.augment else None,
                "max_steps": plan.steps,
                "max_seconds": None if plan.minutes is None else 60.0 * plan.minutes,
                "seed": plan.seed,
            }
        )
    except ValidationError as error:
        first = error.errors()[0]
        name, why = first["loc"][0], first["msg"]
        raise RecognizerError(f"{name} = {first['input']!r}: {why[0].lower()}{why[1:]}") from error


def _network(plan: TrainingPlan) -> PlaceNetwork:
    if plan.trunk not in TRUNKS:
        raise RecognizerError(f"there is no trunk {plan.trunk!r}; there are: {', '.join(TRUNKS)}")
    for name, pair in (("grid", plan.grid), ("size", plan.size)):
        if pair is not None and min(pair) < 1:
            raise RecognizerError(f"{name} = {pair[0]} {pair[1]}: both numbers must be at least 1")
    return PlaceNetwork(
        TRUNKS[plan.trunk],
        plan.dimension,
        block=plan.block,
        grid=plan.grid,
        covariance=plan.covariance,
        words=plan.words,
        size_px=plan.size,
        seed=plan.seed,
    )


def _hash_file(path: Path | None) -> str:
    return _hash(path.read_bytes()) if path else "random weights"


def _hash(content: bytes | str) -> str:
    data = content.encode() if isinstance(content, str) else content
    return hashlib.sha256(data).hexdigest()[:DIGITS]


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecognizerError(f"cannot make the folder: {error.strerror}: {folder}") from error


@torch.no_grad()
def _start_last_layers(
    network: PlaceNetwork,
    plan: TrainingPlan,
    images: LabelledImages,
    device: torch.device,
    progress: Progress,
) -> None:
    network.to(device).eval()
    if isinstance(network.pool[-1], Vlad):
        maps = torch.cat(list(_maps(network, images, WORDS_FROM, device, progress)))
        local = network.pool[:-1](maps).permute(0, 2, 3, 1).flatten(end_dim=2)
        network.pool[-1].start(local, plan.seed)
    if plan.random_last_layer:
        return
    maps_of_all = _maps(network, images, COMPONENTS_FROM, device, progress)
    whiten(network, torch.cat([network.flatten(maps) for maps in maps_of_all]), plan.seed)


def _maps(
    network: PlaceNetwork,
    images: LabelledImages,
    at_most: int,
    device: torch.device,
    progress: Progress,
) -> Iterator[Tensor]:
    """Yield the trunk's maps of some images, as many of each collection."""
    chosen = images.spread(at_most)
    for start in range(0, len(chosen), IMAGES_PER_PASS):
        part = [images[int(i)] for i in chosen[start : start + IMAGES_PER_PASS]]
        yield network.features(network.prepare(part).to(device))
        progress(start + len(part), len(chosen))

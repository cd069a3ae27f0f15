# SPDX-License-Identifier: Apache-2.0
"""A training as planned: from a network's starting weights to the files that it leaves."""

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from placerec.datasets import LabelledImages
from placerec.errors import RecognizerError
from placerec.files import Progress
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.pooling import Vlad
from placerec.networks.pretrained import load_pretrained, make_folder
from placerec.networks.weights_file import save_weights
from placerec.networks.whitening import merge, whiten
from placerec.recognizers.learned import LearnedRecognizer
from placerec.training.checkpoint import short_hash
from placerec.training.config import TrainingConfig
from placerec.training.learner import IMAGES_PER_PASS
from placerec.training.log import read_log, write_plot
from placerec.training.loop import LOG_NAME, Training
from placerec.training.workers import Workers

WEIGHTS_NAME = "weights.safetensors"
_COMPONENTS_FROM, _WORDS_FROM = 2000, 300
"""Images, as many of each collection, that principal components are taken from, and words for
NetVLAD; more cost time and memory."""


def start_training(
    config: TrainingConfig, images: LabelledImages, folder: Path, workers: Workers, look: Progress
) -> Training:
    """Return a training as configured, or the one that the folder holds a checkpoint of.

    The trunk starts from the given weights, the fully connected layer from the whitened principal
    components of what the trunk makes of the images, or from random weights. `look` is called while
    images are looked at; the folder is made where it is missing.

    Raises:
        RecognizerError: the network or its weights cannot be used, the checkpoint is damaged or of
            another training, or the folder cannot be written to.
    """
    network, start = _network(config), "random weights"
    if config.weights is not None:
        load_pretrained(network, config.weights)
        start = short_hash(config.weights.read_bytes())
    make_folder(folder)
    _start_last_layers(network.to(workers.device).eval(), config, images, workers.device, look)
    origin = {"start": start, "names of images": short_hash("\n".join(images.names).encode())}
    return Training(network, images, config, folder, workers=workers, progress=look, origin=origin)


def write_results(training: Training, config: TrainingConfig, folder: Path) -> Path:
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
    save_weights(training.network, path, 1.0 - config.gamma_prime / 2.0)
    try:
        certificate = LearnedRecognizer(path).certificate
    except RecognizerError:  # it is of earlier weights: these have to be calibrated anew
        certificate = None
    if certificate:
        save_weights(training.network, path, certificate.min_similarity)
    write_plot(read_log(folder / LOG_NAME), folder / "log.png")
    return path


def _network(config: TrainingConfig) -> PlaceNetwork:
    if config.trunk not in TRUNKS:
        known = ", ".join(TRUNKS)
        raise RecognizerError(f"there is no trunk {config.trunk!r}; there are: {known}")
    for name, pair in (("grid", config.grid), ("size", config.size)):
        if pair is not None and min(pair) < 1:
            raise RecognizerError(f"{name} = {pair[0]} {pair[1]}: both numbers must be at least 1")
    return PlaceNetwork(
        TRUNKS[config.trunk],
        config.dimension,
        block=config.block,
        grid=config.grid,
        covariance=config.covariance,
        words=config.words,
        size_px=config.size,
        seed=config.seed,
    )


@torch.no_grad()
def _start_last_layers(
    network: PlaceNetwork,
    config: TrainingConfig,
    images: LabelledImages,
    device: torch.device,
    look: Progress,
) -> None:
    def maps_of(at_most: int) -> Iterator[Tensor]:
        """Yield the trunk's maps of some images, as many of each collection."""
        chosen = images.spread(at_most)
        for start in range(0, len(chosen), IMAGES_PER_PASS):
            part = [images[int(i)] for i in chosen[start : start + IMAGES_PER_PASS]]
            yield network.features(network.prepare(part).to(device))
            look(start + len(part), len(chosen))

    if isinstance(network.pool[-1], Vlad):
        maps = torch.cat(list(maps_of(_WORDS_FROM)))
        local = network.pool[:-1](maps).permute(0, 2, 3, 1).flatten(end_dim=2)
        network.pool[-1].start(local, config.seed)
    if not config.random_last_layer:
        values = torch.cat([network.flatten(maps) for maps in maps_of(_COMPONENTS_FROM)])
        whiten(network, values, config.seed)

# SPDX-License-Identifier: Apache-2.0
"""All that a training needs to go on as if it had never been stopped."""

import hashlib
import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from placerec.datasets import LabelledImages
from placerec.errors import RecognizerError
from placerec.files import MOST_WEIGHTS_BYTES, read_bytes, write_atomically
from placerec.networks import PlaceNetwork
from placerec.networks.pretrained import load_pickle
from placerec.training.config import TrainingConfig
from placerec.training.images import Augmentation

_MAY_CHANGE = {"steps", "minutes", "learning_rate", "trunk_learning_rate"}
"""Settings that a resumed training need not share with its beginning."""
_MOST_BYTES = 3 * MOST_WEIGHTS_BYTES
"""The optimizer keeps two numbers for each of the network's."""
_SEEN_IN_NETWORK = {
    *("trunk", "block", "grid", "covariance", "words", "size", "dimension"),
    *("weights", "random_last_layer"),
}


@dataclass(frozen=True)
class Checkpoint:
    """The state of a training between two steps.

    All random numbers follow from the seed and these counts, so no generator needs to be kept.

    Attributes:
        settings: the training's settings and data, by name; it goes on only with the same.
        network, optimizer: their state dicts.
        positives, negatives: (S, A) and (S, B) int64, the present round's image sets.
        used: how many of these were learned from already.
        round, step: how often sets were built, and how many steps were made.
        elapsed_s: time spent so far.
    """

    settings: dict[str, str]
    network: dict[str, Tensor]
    optimizer: dict[str, Any]
    positives: Tensor
    negatives: Tensor
    used: int
    round: int
    step: int
    elapsed_s: float


_KINDS = {"settings": dict, "network": dict, "optimizer": dict} | {
    **dict.fromkeys(("positives", "negatives"), Tensor),
    **dict.fromkeys(("used", "round", "step"), int),
    "elapsed_s": float,
}


def settings_of(
    config: TrainingConfig, network: PlaceNetwork, images: LabelledImages
) -> dict[str, str]:
    """Return what a training must share with the checkpoint it goes on from, by name.

    The network is asked for as it is before the first step.
    """
    size, last = network.preprocessing, type(network.fully_connected)
    labels = np.ascontiguousarray(images.places, np.int64).tobytes()
    count, collections = len(images.scenes), len(np.unique(images.collections))
    described = asdict(config) | asdict(config.rules)
    described["augmentation"] = asdict(Augmentation()) if described.pop("augment") else None
    for name in _MAY_CHANGE | _SEEN_IN_NETWORK:
        del described[name]
    return {name: json.dumps(value) for name, value in described.items()} | {
        "network": f"{network.trunk.name} to {network.block}, {network.dimension} values of "
        f"{network.grid} cells of {size.width_px} x {size.height_px} px, "
        f"covariance {network.covariance}, words {network.words}",
        "last layer": "random at first" if last is nn.Linear else "whitened at first",
        "images": f"{count} with labels {short_hash(labels)}"
        + (f" in {collections} collections" if collections > 1 else ""),
    }


def short_hash(content: bytes) -> str:
    """Return what settings name long contents by."""
    return hashlib.sha256(content).hexdigest()[:12]


def write_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint, leaving the last one untouched until it is complete.

    Raises:
        RecognizerError: it cannot be written.
    """
    buffer = io.BytesIO()
    torch.save(vars(checkpoint), buffer)
    write_atomically(path, buffer.getvalue())


def read_checkpoint(path: Path, settings: dict[str, str]) -> Checkpoint:
    """Read the checkpoint of a training with these settings.

    Raises:
        RecognizerError: it cannot be read, is damaged, or is of a training with other settings.
    """
    content = read_bytes(path, _MOST_BYTES, what="the checkpoint", kind=RecognizerError)
    try:
        loaded = load_pickle(content)
        if not all(isinstance(loaded[name], kind) for name, kind in _KINDS.items()):
            raise TypeError("something in it is of another kind")
        checkpoint = Checkpoint(**loaded)
    except Exception as error:  # torch raises many kinds for a damaged file
        what = "the checkpoint is damaged; remove it to start anew"
        raise RecognizerError(f"{what}: {path}") from error
    for name in sorted(settings.keys() | checkpoint.settings.keys()):
        now, then = settings.get(name, "unset"), checkpoint.settings.get(name, "unset")
        if now != then:
            raise RecognizerError(
                f"the checkpoint is of another training: its {name} is {then}, not {now}; "
                f"use the same or another folder: {path}"
            )
    return checkpoint

# SPDX-License-Identifier: Apache-2.0
"""All that a training needs to go on as if it had never been stopped."""

import io
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from placerec.output_file import write_atomically
from placerec.recognizer import RecognizerError


@dataclass(frozen=True)
class Checkpoint:
    """The state of a training between two steps.

    All random numbers follow from the seed and these counts, so no generator needs to be kept.

    Attributes:
        settings: the training's settings and data, by name; it goes on only with the same.
        network: the network's state dict.
        optimizer: the optimizer's state dict.
        positives, negatives: (S, A) and (S, B) int64, the present round's image sets.
        used: how many of these were learned from already.
        round: how often sets were built.
        step: how many steps were made.
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


def write_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint, leaving the last one untouched until it is complete.

    Raises:
        RecognizerError: it cannot be written.
    """
    buffer = io.BytesIO()
    torch.save(
        {field.name: getattr(checkpoint, field.name) for field in fields(Checkpoint)}, buffer
    )
    write_atomically(path, buffer.getvalue())


def read_checkpoint(path: Path, settings: dict[str, str]) -> Checkpoint:
    """Read the checkpoint of a training with these settings.

    Raises:
        RecognizerError: it cannot be read, is damaged, or is of a training with other settings.
    """
    try:
        content = io.BytesIO(path.read_bytes())
    except OSError as error:
        raise RecognizerError(f"cannot read the checkpoint: {error.strerror}: {path}") from error
    try:
        checkpoint = Checkpoint(**torch.load(content, map_location="cpu", weights_only=True))
    except Exception as error:  # torch raises many kinds for a damaged file
        raise RecognizerError(
            f"the checkpoint is damaged; remove it to start anew: {path}"
        ) from error
    for name in sorted(settings.keys() | checkpoint.settings.keys()):
        now, then = settings.get(name, "unset"), checkpoint.settings.get(name, "unset")
        if now != then:
            raise RecognizerError(
                f"the checkpoint is of another training: its {name} is {then}, not {now}; "
                f"use the same or another folder: {path}"
            )
    return checkpoint

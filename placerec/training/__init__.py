# SPDX-License-Identifier: Apache-2.0
"""The paper's training: sets of images, losses, and a loop that can be stopped and gone on with."""

from typing import TYPE_CHECKING

from placerec.training.config import TrainingConfig

if TYPE_CHECKING:
    from placerec.training.loop import Training

__all__ = ["Training", "TrainingConfig"]


def __getattr__(name: str) -> object:
    if name != "Training":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # Only now, because torch takes seconds that the flags of the command do not need.
    from placerec.training.loop import Training

    return Training

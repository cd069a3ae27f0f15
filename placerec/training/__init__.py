# SPDX-License-Identifier: Apache-2.0
"""The paper's training: sets of images, losses, and a loop that can be stopped and gone on with."""

from placerec.training.config import TrainingConfig
from placerec.training.loop import Training

__all__ = ["Training", "TrainingConfig"]

# SPDX-License-Identifier: Apache-2.0
"""The sub-commands of `placerec`, one to a file."""

from placerec.commands.calibrate import calibrate
from placerec.commands.check import check
from placerec.commands.evaluate import evaluate
from placerec.commands.fit import fit
from placerec.commands.train import train

__all__ = ["calibrate", "check", "evaluate", "fit", "train"]

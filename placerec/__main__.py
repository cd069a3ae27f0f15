# SPDX-License-Identifier: Apache-2.0
"""The `placerec` command, also as `python -m placerec`."""

import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from placerec.commands.calibrate import calibrate
from placerec.commands.check import check
from placerec.commands.evaluate import evaluate
from placerec.commands.fit import fit
from placerec.commands.train import train
from placerec.errors import LoopcloseError

_BAD_USAGE = 2
_DESCRIPTION = "Recognise places: train, check, measure and calibrate what tells them apart."

_app = tyro.extras.SubcommandApp()
for command in (check, evaluate, calibrate, fit, train):
    _app.command(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `placerec` and return its exit code: 0 good, 1 does not conform, 2 bad input."""
    # A class that is being written is found in the current folder, as by `python -m`.
    sys.path.append(str(Path.cwd()))
    try:
        return int(_app.cli(prog="placerec", args=arguments, description=_DESCRIPTION))
    except LoopcloseError as error:
        print(f"placerec: {error}", file=sys.stderr)
        return _BAD_USAGE


if __name__ == "__main__":
    sys.exit(main())

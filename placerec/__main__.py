# SPDX-License-Identifier: Apache-2.0
"""The `placerec` command, also as `python -m placerec`."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial, wraps
from pathlib import Path

import tyro

from placerec.commands import usage
from placerec.commands.console import answer
from placerec.errors import LoopcloseError, RecognizerError

_DESCRIPTION = "Recognise places: train, check, measure and calibrate what tells them apart."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `placerec` and return its exit code: 0 good, 1 does not conform, 2 bad input."""
    # A class that is being written is found in the current folder, as by `python -m`.
    sys.path.append(str(Path.cwd()))
    typed = sys.argv[1:] if arguments is None else arguments
    return answer("placerec", typed, _work, interrupted="interrupted before it was done")


def _work(typed: list[str]) -> int:
    try:
        return _parse(typed)()
    except LoopcloseError as error:
        # Loaded here: only a setting that is wrong needs the names of all.
        from placerec.training.config import TrainingConfig

        names = [each.name for each in fields(TrainingConfig)]
        raise RecognizerError(usage.as_typed(str(error), names)) from error


def _parse(typed: list[str]) -> Callable[[], int]:
    """Return what was asked for, to be called.

    Raises:
        RecognizerError: something is wrong with what was typed.
    """

    def read(left: list[str]) -> Callable[[], int]:
        # Loaded here, so that --version and typing errors of its kind answer at once.
        from placerec.commands.adapt import adapt
        from placerec.commands.calibrate import calibrate
        from placerec.commands.check import check
        from placerec.commands.embed import embed
        from placerec.commands.evaluate import evaluate
        from placerec.commands.export import export
        from placerec.commands.fit import fit
        from placerec.commands.train import train

        commands = (check, embed, evaluate, calibrate, fit, train, adapt, export)
        told = (f"  {each.__name__:<10} {str(each.__doc__).splitlines()[0]}" for each in commands)
        app = tyro.extras.SubcommandApp()
        for command in commands:
            app.command(_later(command))
        asked: Callable[[], int] = app.cli(
            prog="placerec", args=left, description="\n".join((_DESCRIPTION, "", *told))
        )
        return asked

    return usage.answered("placerec", typed, read)


def _later(command: Callable[..., int]) -> Callable[..., Callable[[], int]]:
    """Return what takes a command's arguments and waits: only parsing is to be watched."""

    @wraps(command)
    def wait(*arguments: object, **named: object) -> Callable[[], int]:
        return partial(command, *arguments, **named)

    return wait


if __name__ == "__main__":
    sys.exit(main())

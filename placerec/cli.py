# SPDX-License-Identifier: Apache-2.0
"""The `placerec` command: one function per sub-command."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from placerec.conformance import Report
from placerec.conformance import check as check_recognizer
from placerec.recognizer import RecognizerError, load

DOES_NOT_CONFORM, BAD_USAGE = 1, 2

app = tyro.extras.SubcommandApp()


@app.command
def check(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|MODULE:CLASS")],
    /,
) -> int:
    """Tell what a recognizer does right and wrong.

    Args:
        recognizer: an installed recognizer's name, or package.module:ClassName.
    """
    report = check_recognizer(load(recognizer))
    print(_table(report))
    return 0 if report.passed else DOES_NOT_CONFORM


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `placerec` and return its exit code: 0 good, 1 does not conform, 2 bad usage."""
    # A class that is being written is found in the current folder, as by `python -m`.
    sys.path.append(str(Path.cwd()))
    try:
        return int(app.cli(prog="placerec", args=arguments, description=__doc__))
    except RecognizerError as error:
        print(f"placerec: {error}", file=sys.stderr)
        return BAD_USAGE


def _table(report: Report) -> str:
    width = max(len(check.name) for check in report.checks)
    return "\n".join(
        f"{'ok  ' if check.passed else 'FAIL'}  {check.name:<{width}}  {check.detail}"
        for check in report.checks
    )


if __name__ == "__main__":
    sys.exit(main())

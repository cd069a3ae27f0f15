# SPDX-License-Identifier: Apache-2.0
"""`placerec check`: does a recognizer keep to the protocol?"""

from typing import Annotated

import tyro

from placerec.commands.data import RECOGNIZER
from placerec.conformance import Report
from placerec.conformance import check as check_recognizer
from placerec.recognizer import load

DOES_NOT_CONFORM = 1


def check(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar=RECOGNIZER)],
    /,
) -> int:
    """Tell what a recognizer does right and wrong.

    Args:
        recognizer: an installed name, package.module:ClassName, or trained weights.
    """
    report = check_recognizer(load(recognizer))
    print(_table(report))
    return 0 if report.passed else DOES_NOT_CONFORM


def _table(report: Report) -> str:
    width = max(len(check.name) for check in report.checks)
    return "\n".join(
        f"{'ok  ' if check.passed else 'FAIL'}  {check.name:<{width}}  {check.detail}"
        for check in report.checks
    )

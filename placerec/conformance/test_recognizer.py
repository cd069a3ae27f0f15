# SPDX-License-Identifier: Apache-2.0
"""The checks as tests: `pytest --pyargs placerec.conformance --recognizer NAME`."""

import sys
import warnings
from collections.abc import Callable

import pytest

from placerec.conformance.examination import CHECKS, Examination
from placerec.conformance.subject import Check, Verdict
from placerec.errors import RecognizerError
from placerec.recognizer import load


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make a test of every check of the recognizer that the command line names."""
    name: str | None = metafunc.config.getoption("--recognizer")
    if name is None:
        pytest.fail("say what to check: --recognizer NAME|MODULE:CLASS|FILE", pytrace=False)
    # As `placerec check` does: a class that is being written is found in the current folder.
    sys.path.append(str(metafunc.config.invocation_params.dir))
    try:
        examination = Examination(load(name), name)
    except RecognizerError as error:
        raise pytest.fail.Exception(str(error), pytrace=False) from None
    tests = [pytest.param(examination, check, id=check.name) for check in CHECKS]
    metafunc.parametrize(("examination", "check"), tests)


def test_recognizer(
    examination: Examination, check: Check, record_property: Callable[[str, object], None]
) -> None:
    """Fail with what was measured and what to do about it."""
    finding = examination.find(check)
    record_property("measured", finding.measured)
    if finding.verdict is Verdict.NOT_TRIED:
        pytest.skip(finding.measured)
    if finding.verdict is Verdict.DOUBTFUL:
        warnings.warn(f"{check.name}: {finding.measured} -> {check.remedy}", stacklevel=1)
    if finding.failed:
        pytest.fail(f"{finding.measured}\n-> {check.remedy}", pytrace=False)

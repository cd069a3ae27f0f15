# SPDX-License-Identifier: Apache-2.0
"""The option of pytest that names the recognizer to check: pytest reads it from no conftest.py.

It is loaded with every pytest where this package is installed, and so does nothing else.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest


def pytest_addoption(parser: "pytest.Parser") -> None:
    """Add the option; `placerec.conformance.test_recognizer` reads it."""
    parser.getgroup("placerec").addoption(
        "--recognizer",
        metavar="NAME|MODULE:CLASS|FILE",
        help="the place recognizer that `--pyargs placerec.conformance` checks",
    )

# SPDX-License-Identifier: Apache-2.0
"""What the README shows works as it stands there."""

import re
from pathlib import Path

import pytest

from placerec.conformance import check

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")


def test_its_recognizer_conforms():
    code = next(block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL))
    found: dict[str, type] = {}
    exec(code, found)
    report = check(found["ColourLayout"]())
    assert report.passed, str(report)


def test_its_commands_are_what_every_change_is_checked_by():
    install, run_tests = "python -m pip install '.[test]'", "pytest -n auto"
    assert f"\n    {install} && {run_tests}\n" in README
    steps = (ROOT / ".ci" / "run").read_text()
    assert f"\nstep {install}\nstep {run_tests}" in steps


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str):
    targets = re.findall(r"\]\((?!https?:)([^)]+)\)", (ROOT / page).read_text())
    assert [target for target in targets if not (ROOT / target).exists()] == []

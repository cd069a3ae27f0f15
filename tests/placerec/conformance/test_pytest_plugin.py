# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from placerec.conformance.examination import CHECKS

HERE = Path(__file__).parent
PYPROJECT = tomllib.loads((HERE.parents[2] / "pyproject.toml").read_text())


@pytest.fixture
def run_pytest(tmp_path):
    """Return what runs pytest as an author would, in a folder of the author's."""
    installed = tmp_path / "site" / "loopclose-0.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text("Name: loopclose\nVersion: 0\n")
    plugin = PYPROJECT["project"]["entry-points"]["pytest11"]["placerec"]
    (installed / "entry_points.txt").write_text(f"[pytest11]\nplacerec = {plugin}\n")
    paths = [str(installed.parent), str(HERE), *sys.path]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in paths if path)}
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:dash"]

    def run(*arguments):
        arguments = ("--pyargs", "placerec.conformance", *arguments)
        return subprocess.run(
            [*command, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True
        )

    return run


def test_each_check_is_a_test_that_keeps_what_was_measured(run_pytest, tmp_path):
    done = run_pytest("--recognizer", "faulty_recognizers:Sound", "--junit-xml", "out.xml")
    assert done.returncode == 0, done.stdout
    cases = list(ET.parse(tmp_path / "out.xml").iter("testcase"))
    assert [case.get("name") for case in cases] == [f"test_recognizer[{c.name}]" for c in CHECKS]
    measured = [prop.get("value") for case in cases for prop in case.iter("property")]
    assert len(measured) == len(CHECKS)
    assert "(49,)" in measured


def test_a_failure_is_what_was_measured_and_what_to_do_without_a_traceback(run_pytest):
    done = run_pytest("--recognizer", "faulty_recognizers:Long", "-rs")
    assert done.returncode == 1
    assert "\nlengths 2 to 2\n-> return v / np.linalg.norm(v); " in done.stdout
    assert "first mend 'unit length'" in done.stdout
    assert "1 failed" in done.stdout
    assert "Traceback" not in done.stdout
    assert "test_recognizer.py:" not in done.stdout.split("short test summary")[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "say what to check: --recognizer NAME|MODULE:CLASS|FILE"),
        (("--recognizer", "no-such-thing"), "there is no recognizer 'no-such-thing'"),
    ],
)
def test_without_a_recognizer_nothing_is_tested_and_one_line_says_why(
    run_pytest, arguments, message
):
    done = run_pytest(*arguments)
    assert done.returncode == 2
    assert f"\n{message}" in done.stdout
    assert "above exception" not in done.stdout


def test_a_class_that_is_being_written_is_found_in_the_current_folder(run_pytest, tmp_path):
    (tmp_path / "draft.py").write_text("from faulty_recognizers import Sound as Draft\n")
    done = run_pytest("--recognizer", "draft:Draft", "-k", "float32")
    assert done.returncode == 0, done.stdout
    assert "1 passed" in done.stdout

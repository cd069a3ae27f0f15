# SPDX-License-Identifier: Apache-2.0
"""The example passes the conformance kit, by both of its doors."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from placerec.__main__ import main
from placerec.recognizer import available

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "own_recognizer"


@pytest.fixture(autouse=True)
def installed(tmp_path, monkeypatch):
    """Leave behind what `pip install` would, without the network that a build needs."""
    for source in (EXAMPLE, ROOT):
        project = tomllib.loads((source / "pyproject.toml").read_text())["project"]
        about = tmp_path / f"{project['name']}-{project['version']}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Name: {project['name']}\nVersion: 0.1.0\n")
        with (about / "entry_points.txt").open("w") as file:
            for group, entries in project["entry-points"].items():
                lines = (f"{name} = {value}" for name, value in entries.items())
                print(f"[{group}]", *lines, sep="\n", file=file)
    monkeypatch.setattr(sys, "path", [str(tmp_path), str(EXAMPLE), *sys.path])


def test_it_is_found_by_its_name():
    assert "colours" in available()


def test_placerec_check(capsys):
    assert main(["check", "colours"]) == 0
    assert capsys.readouterr().out.endswith("\nall checks passed\n")


def test_pytest_pyargs(tmp_path):
    what = ["--pyargs", "placerec.conformance", "--recognizer", "colours"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:dash", *what],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert " passed in " in done.stdout
    assert "skipped" not in done.stdout

# SPDX-License-Identifier: Apache-2.0
import sys
import tomllib
from pathlib import Path

from placerec.conformance import check
from placerec.recognizer import available, load

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_recognizer"


def test_installed_example_is_found_by_name_and_conforms(tmp_path, monkeypatch):
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    # What `pip install` would leave behind, without the network that a build needs.
    installed = tmp_path / f"{project['name']}-{project['version']}.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Name: {project['name']}\nVersion: 0.1.0\n")
    entries = project["entry-points"]["placerec.recognizers"]
    lines = ["[placerec.recognizers]", *(f"{name} = {path}" for name, path in entries.items())]
    (installed / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.setattr(sys, "path", [str(tmp_path), str(EXAMPLE), *sys.path])

    assert "colours" in available()
    report = check(load("colours"))
    assert report.passed, report

# SPDX-License-Identifier: Apache-2.0
"""What keeps the house in order beyond what ruff and import-linter hold."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from importlib.resources import files
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
PACKAGES = ("slam", "placerec")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MOST_ENTRIES = 18
NAMES_THAT_SAY_NOTHING = {"utils", "util", "core", "common", "helpers", "base", "misc"}

FOR_DEVELOPERS = {"test", "dev"}

# What pytest loads may import it: who has no pytest never gets there.
LOADED_BY_PYTEST = {
    "placerec/conformance/test_recognizer.py",
    "placerec/conformance/pytest_plugin.py",
}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_a_module_has_a_name_that_says_something_and_a_licence(path: Path):
    assert not NAMES_THAT_SAY_NOTHING & set(Path(name(path)).with_suffix("").parts)
    text = path.read_text()
    assert text.startswith("# SPDX-License-Identifier: Apache-2.0\n")


def test_a_folder_can_be_read_at_a_glance():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if tracked.returncode:
        pytest.skip("not a git checkout")
    entries: dict[Path, set[str]] = {}
    for line in tracked.stdout.splitlines():
        parts = Path(line).parts
        for depth in range(1, len(parts)):
            entries.setdefault(Path(*parts[:depth]), set()).add(parts[depth])
    crowded = {
        str(folder): len(names) for folder, names in entries.items() if len(names) > MOST_ENTRIES
    }
    assert crowded == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_installed_is_complete(package: str):
    """Data files are easily left out of a wheel: the page's template, weights, py.typed."""
    sources = {
        path.relative_to(ROOT / package).as_posix()
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    missing = {source for source in sources if not files(package).joinpath(source).is_file()}
    assert "py.typed" in sources
    assert not missing


def test_every_library_that_is_imported_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = project["dependencies"] + [
        line for name, lines in extras.items() if name not in FOR_DEVELOPERS for line in lines
    ]
    declared = {normalized(re.split(r"[\[<>=; ]", line)[0]) for line in lines}
    owners = packages_distributions()
    modules = [path for path in MODULES if name(path) not in LOADED_BY_PYTEST]
    libraries = {library for path in modules for library in imports(path)} - set(PACKAGES)
    undeclared = {
        library
        # Of what is not installed nobody knows the owner; where all is, none is left out.
        for library in (libraries - sys.stdlib_module_names) & owners.keys()
        if declared.isdisjoint(map(normalized, owners[library]))
    }
    assert undeclared == set()


def normalized(distribution: str) -> str:
    """Return a name in the one way that stands for all ways to write it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def imports(path: Path) -> set[str]:
    """Return the top-level names that a module imports, wherever in the file."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    modules = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    modules += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {module.split(".")[0] for module in modules}


@pytest.mark.parametrize("number, package", [(0, "slam"), (1, "placerec")])
def test_the_layers_that_people_read_are_those_that_are_checked(number: int, package: str):
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = contracts["contracts"][number]["layers"]
    table = CONTRIBUTING.split(f"| `{package}` |")[1].split("\n\n")[0]
    rows = [re.findall(r"`(\w+)`", row.split(" | ")[0]) for row in table.splitlines()[2:]]
    assert [set(row) for row in rows] == [set(layer.split(" | ")) for layer in layers]


WAYS = CONTRIBUTING.split("## Five ways through the code")[1].split("\n## ")[0].split("\n**")[1:]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.split("**")[0])
def test_the_ways_through_the_code_are_there_and_short(way: str):
    steps = re.findall(r"`(\S+): ([\w.]+)`", way)
    assert 1 < len(steps) <= 7
    assert len({file for file, _ in steps}) == len(steps)
    for file, function in steps:
        scope = ast.parse((ROOT / file).read_text()).body
        for part in function.split("."):
            (found,) = [
                node
                for node in scope
                if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == part
            ]
            scope = found.body

# SPDX-License-Identifier: Apache-2.0
"""What keeps the house in order beyond what ruff and import-linter hold."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from importlib.resources import files
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("slam", "placerec")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
ROOMS = [path for path in MODULES if path.name != "__init__.py"]
MAX_LINES = 250
NAMES_THAT_SAY_NOTHING = {"utils", "util", "core", "common", "helpers", "base", "misc"}

# Parts that show their behaviour only as a whole, and the test that runs them to the last lines.
TESTED_WITHIN = {
    "placerec/checkpoint.py": "placerec/test_training.py",
    "placerec/commands/calibrate.py": "placerec/test_cli.py",
    "placerec/commands/check.py": "placerec/test_cli.py",
    "placerec/commands/data.py": "placerec/test_cli.py",
    "placerec/commands/evaluate.py": "placerec/test_cli.py",
    "placerec/commands/train.py": "placerec/test_training_run.py",
    "placerec/conformance/answer.py": "placerec/conformance/test_examination.py",
    "placerec/conformance/finding.py": "placerec/conformance/test_examination.py",
    "placerec/conformance/memory.py": "placerec/conformance/test_examination.py",
    "placerec/conformance/pictures.py": "placerec/conformance/test_examination.py",
    "placerec/conformance/recognition.py": "placerec/conformance/test_examination.py",
    "placerec/conformance/repetition.py": "placerec/conformance/test_examination.py",
    "placerec/conformance/subject.py": "placerec/conformance/test_examination.py",
    "placerec/conformance/test_recognizer.py": "placerec/test_pytest_plugin.py",
    "placerec/early_layers.py": "placerec/test_training.py",
    "placerec/learner.py": "placerec/test_training.py",
    "placerec/networks/alexnet.py": "placerec/networks/test_pretrained.py",
    "placerec/networks/mobilenet_v2.py": "placerec/networks/test_pretrained.py",
    "placerec/networks/one_thread.py": "placerec/test_embedding.py",
    "placerec/networks/squeezenet.py": "placerec/networks/test_pretrained.py",
    "placerec/networks/trunk.py": "placerec/networks/test_place_network.py",
    "placerec/networks/vgg16.py": "placerec/networks/test_pretrained.py",
    "placerec/output_file.py": "placerec/test_training.py",
    "placerec/place_images.py": "placerec/test_training.py",
    "placerec/training_config.py": "placerec/test_training.py",
    "placerec/training_plan.py": "placerec/test_training_run.py",
    "placerec/workers.py": "placerec/test_training.py",
    "slam/datasets/archive.py": "slam/datasets/test_download.py",
    "slam/datasets/intrinsics.py": "slam/datasets/test_open3d_folder.py",
    "slam/datasets/numbered_images.py": "slam/datasets/test_scannet.py",
    "slam/datasets/rooms/furniture.py": "slam/datasets/rooms/test_room.py",
    "slam/datasets/rooms/panels.py": "slam/datasets/rooms/test_room.py",
    "slam/datasets/rooms/pictures.py": "slam/datasets/rooms/test_room.py",
    "slam/datasets/tables.py": "slam/datasets/test_tum.py",
    "slam/datasets/transfer.py": "slam/datasets/test_download.py",
    "slam/datasets/true_poses.py": "slam/datasets/test_seven_scenes.py",
    "slam/parts.py": "slam/test_atlas.py",
    "slam/placement.py": "slam/test_odometry.py",
    "slam/pose_graph/agreement.py": "slam/pose_graph/test_graph.py",
    "slam/pose_graph/batch.py": "slam/pose_graph/test_robust.py",
    "slam/report/canvas.py": "slam/report/test_page.py",
    "slam/report/path_figures.py": "slam/report/test_page.py",
    "slam/report/place_figures.py": "slam/report/test_page.py",
    "slam/types.py": "slam/report/test_page.py",
    "slam/verdict.py": "slam/test_ledger.py",
}


# What pytest loads may import it: who has no pytest never gets there.
LOADED_BY_PYTEST = {"placerec/conformance/test_recognizer.py", "placerec/pytest_plugin.py"}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def mirror(module: str) -> str:
    path = Path(module)
    return path.with_name(f"test_{path.name}").as_posix()


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_a_module_is_one_noun_of_readable_size(path: Path):
    assert not NAMES_THAT_SAY_NOTHING & set(Path(name(path)).with_suffix("").parts)
    text = path.read_text()
    assert text.startswith("# SPDX-License-Identifier: Apache-2.0\n")
    assert len(text.splitlines()) <= MAX_LINES


@pytest.mark.parametrize("path", ROOMS, ids=name)
def test_tests_mirror_the_tree(path: Path):
    test = TESTED_WITHIN.get(name(path), mirror(name(path)))
    assert (ROOT / "tests" / test).is_file()


def test_no_exception_outlives_its_reason():
    assert set(TESTED_WITHIN) <= {name(path) for path in ROOMS}
    mirrored = [part for part in TESTED_WITHIN if (ROOT / "tests" / mirror(part)).is_file()]
    assert mirrored == []


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
    declared = {re.split(r"[<>=; ]", line)[0].lower() for line in project["dependencies"]}
    owners = packages_distributions()
    modules = [path for path in MODULES if name(path) not in LOADED_BY_PYTEST]
    libraries = {library for path in modules for library in imports(path)} - set(PACKAGES)
    undeclared = {
        library
        for library in libraries - sys.stdlib_module_names
        if declared.isdisjoint(owner.lower() for owner in owners[library])
    }
    assert undeclared == set()


def imports(path: Path) -> set[str]:
    """Return the top-level names that a module imports, wherever in the file."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    modules = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    modules += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {module.split(".")[0] for module in modules}


def test_the_layers_that_people_read_are_those_that_are_checked():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = contracts["contracts"][0]["layers"]
    table = (ROOT / "CONTRIBUTING.md").read_text().split("| `slam` |")[1].split("\n\n")[0]
    rows = [re.findall(r"`(\w+)`", row.split(" | ")[0]) for row in table.splitlines()[2:]]
    assert [set(row) for row in rows] == [set(layer.split(" | ")) for layer in layers]

# SPDX-License-Identifier: Apache-2.0
"""What users import, and that nobody outside the packages imports anything else."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("slam", "placerec")
OPEN = {*PACKAGES, "slam.datasets", "slam.demo", "placerec.datasets"}
SHOWN = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "examples").rglob("*.py")),
]
HEAVY = {"torch", "open3d", "gtsam", "cv2", "matplotlib", "numpy"}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_there_and_none_other(package: str):
    module = import_module(package)
    assert sorted(module.__all__) == module.__all__ == dir(module)
    assert all(getattr(module, name) for name in module.__all__)
    with pytest.raises(AttributeError, match="no attribute 'sluice'"):
        _ = module.sluice


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_see_the_same_names(package: str):
    tree = ast.parse((ROOT / package / "__init__.py").read_text())
    (shown,) = [node for node in tree.body if isinstance(node, ast.If)]
    imported = [node for node in shown.body if isinstance(node, ast.ImportFrom)]
    names = {alias.name: node.module for node in imported for alias in node.names}
    module = import_module(package)
    assert names == module._HOME
    assert {*names, "__version__"} == set(module.__all__)


def test_importing_costs_nothing_until_a_name_is_used():
    code = "import sys, slam, placerec; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(run.stdout.split())


@pytest.mark.parametrize("page", SHOWN, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_is_shown_imports_the_public_face_alone(page: Path):
    text = page.read_text()
    if page.suffix == ".md":
        text = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    nodes = list(ast.walk(ast.parse(text)))
    modules = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    modules |= {
        alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names
    }
    assert {each for each in modules if each.split(".")[0] in PACKAGES} <= OPEN

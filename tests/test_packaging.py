# SPDX-License-Identifier: Apache-2.0
"""What an installation holds beyond the modules."""

import shutil
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import get_type_hints
from zipfile import ZipFile

from hatchling.builders.wheel import WheelBuilder

from placerec.certificate import certificate_path
from placerec.recognizer import ENTRY_POINT_GROUP
from placerec.recognizers.learned import DEFAULT_WEIGHTS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_trained_weights_their_certificate_and_their_card_come_with_the_wheel(tmp_path):
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, tmp_path)
    card = DEFAULT_WEIGHTS.with_name("README.md")
    fitted = sorted(DEFAULT_WEIGHTS.parent.glob("*.safetensors"))
    assert len(fitted) > 1
    certificates = [certificate_path(path) for path in fitted]
    assert all(path.is_file() for path in certificates)
    data = [path.relative_to(DEFAULT_WEIGHTS.parents[2]) for path in (*fitted, *certificates, card)]
    for path in (*data, Path("slam/__init__.py"), Path("placerec/__init__.py")):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(b"")
    (wheel,) = WheelBuilder(str(tmp_path)).build(directory=str(tmp_path / "dist"))
    with ZipFile(wheel) as archive:
        assert {path.as_posix() for path in data} <= set(archive.namelist())


def test_what_is_installed_stays_small():
    parts = [path for name in ("slam", "placerec") for path in (ROOT / name).rglob("*.*")]
    sizes = [path.stat().st_size for path in parts if "__pycache__" not in path.parts]
    assert sum(sizes) < 17e6  # 10.8 MB are the default network, 1.8 MB draw the report


def test_built_in_recognizers_are_named_as_those_of_others_are():
    declared = PROJECT["entry-points"][ENTRY_POINT_GROUP]
    assert set(declared) >= {"gradients", "learned"}
    for name, value in declared.items():
        recognizer = EntryPoint(name=name, value=value, group=ENTRY_POINT_GROUP).load()
        is_class = isinstance(recognizer, type)
        kind = recognizer if is_class else get_type_hints(recognizer)["return"]
        assert callable(kind.embed) and "min_similarity" in get_type_hints(kind)

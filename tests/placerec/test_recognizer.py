# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import pytest

from placerec.recognizer import PlaceRecognizer, available, load

PLUG_IN = """
class Good:
    min_similarity = 0.5
    def embed(self, image):
        return image

def make():
    return Good()

class NoThreshold:
    min_similarity: float
    def embed(self, image):
        return image

class NoEmbed:
    min_similarity = 0.5

class Fails(Good):
    def __init__(self):
        raise OSError("no weights\\nat all")

number = 3
"""


@pytest.fixture
def packages(tmp_path: Path, monkeypatch):
    """Install distributions of the given names and entry points; return the installer."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *_without_loopclose()])
    monkeypatch.delitem(sys.modules, "plug_in", raising=False)
    (tmp_path / "plug_in.py").write_text(PLUG_IN)

    def install(distribution: str, **entries: str) -> None:
        folder = tmp_path / f"{distribution}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Name: {distribution}\nVersion: 1.0\n")
        lines = ["[placerec.recognizers]", *(f"{k} = {v}" for k, v in entries.items())]
        (folder / "entry_points.txt").write_text("\n".join(lines))

    yield install
    sys.modules.pop("plug_in", None)


def _without_loopclose() -> list[str]:
    # The installed built-ins would otherwise be listed beside those of the test.
    return [p for p in sys.path if not list(Path(p or ".").glob("loopclose-*.dist-info"))]


def test_available_lists_names_without_importing_them(packages):
    packages("theirs", zebra="plug_in:Good", apple="does_not_exist:X")
    assert available() == ("apple", "zebra")
    assert "plug_in" not in sys.modules


@pytest.mark.parametrize("target", ["plug_in:Good", "plug_in:make"])
def test_load_takes_a_class_or_a_factory(packages, target):
    packages("theirs", mine=target, broken="does_not_exist:X")
    assert load("mine").min_similarity == 0.5
    assert isinstance(load(target), PlaceRecognizer)


def test_unknown_name_lists_what_is_installed_and_hints(packages, error_of):
    packages("theirs", apple="plug_in:Good", zebra="plug_in:Good")
    message = error_of(load, "aple")
    assert "did you mean 'apple'" in message
    assert "installed: apple, zebra" in message


def test_one_name_claimed_twice_names_both(packages, error_of):
    packages("first-one", mine="plug_in:Good")
    packages("second-one", mine="plug_in:Good")
    message = error_of(load, "mine")
    assert "first-one and second-one" in message


@pytest.mark.parametrize(
    ("target", "told"),
    [
        ("does_not_exist:X", "cannot be imported: ModuleNotFoundError"),
        ("plug_in:Missing", "cannot be imported: AttributeError"),
        ("plug_in:Fails", "cannot be constructed: OSError: no weights at all"),
        ("plug_in:NoThreshold", "no attribute min_similarity"),
        ("plug_in:NoEmbed", "no method embed"),
        ("plug_in:number", "is a int"),
    ],
)
def test_broken_plug_in_is_one_line_that_names_it(packages, target, told, error_of):
    packages("theirs", mine=target)
    message = error_of(load, "mine")
    assert message.startswith(f"recognizer 'mine' ({target})")
    assert told in message
    assert told in error_of(load, target)


@pytest.mark.parametrize("name", ["a:b:c", ":X", "plug_in:", "plug in:X"])
def test_malformed_class_path(name, error_of):
    assert "package.module:ClassName" in error_of(load, name)

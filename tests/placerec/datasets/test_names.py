# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from placerec.datasets.names import benchmark_name, did_you_mean, find_data
from placerec.files import cache_folder


@pytest.mark.parametrize(
    ("name", "short"),
    [
        ("fr1_desk", "fr1_desk"),
        ("FR1/desk", "fr1_desk"),
        ("freiburg1_desk", "fr1_desk"),
        ("rgbd_dataset_freiburg2_pioneer_slam3", "fr2_pioneer_slam3"),
        ("fr3_office", "fr3_long_office_household"),
        ("fr3_long_office", "fr3_long_office_household"),
    ],
)
def test_a_sequence_has_several_names(name, short):
    assert benchmark_name(name) == short


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Work in an empty folder; data may be in another, and things that were fetched in a third."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("LOOPCLOSE_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def make(folder):
    folder.mkdir(parents=True)
    (folder / "rgb.txt").touch()
    return folder


def test_data_is_here_or_under_the_data_folder_or_fetched(elsewhere, monkeypatch):
    assert find_data("fr1_desk") is None and find_data("corridor") is None
    fetched = make(cache_folder() / "rgbd_dataset_freiburg1_desk")
    assert find_data("fr1_desk") == fetched
    (elsewhere / "data/fr1_desk").mkdir(parents=True)  # holds no sequence
    assert find_data("fr1/desk") == find_data("fr1_desk") == fetched
    kept = make(elsewhere / "data/rgbd_dataset_freiburg1_desk")
    assert find_data("fr1_desk") == find_data("rgbd_dataset_freiburg1_desk") == kept
    corridor = make(elsewhere / "data/corridor")
    assert find_data("corridor") == corridor
    make(Path("corridor"))
    assert find_data("corridor") == Path("corridor")
    monkeypatch.delenv("LOOPCLOSE_DATA")
    assert find_data("fr1_desk") == fetched


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "\udce9", "fr9_desk"])
def test_what_can_be_no_name_is_not_found(elsewhere, name):
    assert find_data(name) is None
    assert benchmark_name(name) is None


def test_names_that_are_close_are_proposed():
    assert did_you_mean("fr1_dsk").startswith("did you mean fr1_desk")
    assert did_you_mean("nothing like it") == ""

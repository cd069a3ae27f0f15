# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from placerec.files import cache_folder


def test_it_follows_the_convention_of_the_desktop(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "loopclose"


@pytest.mark.parametrize("value", ["", "not/absolute"])  # which the convention says to ignore
def test_without_a_usable_setting_it_is_under_the_home(monkeypatch, tmp_path, value):
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache" / "loopclose"

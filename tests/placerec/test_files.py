# SPDX-License-Identifier: Apache-2.0
import errno
import os
from pathlib import Path

import pytest

from placerec.errors import LoopcloseError
from placerec.files import cache_folder, write_atomically


def names_in(folder):
    return [path.name for path in folder.iterdir()]


@pytest.mark.parametrize(("data", "content"), [("Weg ä\n", "Weg ä\n".encode()), (b"\0\1", b"\0\1")])
def test_writes_text_and_bytes_and_leaves_nothing_else(tmp_path, data, content):
    path = tmp_path / "out.txt"
    path.write_text("an older and longer file")
    write_atomically(path, data)
    assert path.read_bytes() == content
    assert names_in(tmp_path) == ["out.txt"]


def test_others_may_read_what_the_user_lets_them_read(tmp_path):
    (tmp_path / "plain").touch()
    write_atomically(tmp_path / "out", b"")
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_failed_write_keeps_the_earlier_file(tmp_path, monkeypatch, code):
    def fail(descriptor):
        raise OSError(code, os.strerror(code))

    path = tmp_path / "out.txt"
    path.write_text("earlier")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(LoopcloseError) as caught:
        write_atomically(path, "later")
    assert os.strerror(code) in str(caught.value)
    assert str(caught.value).endswith(str(path))
    assert "\n" not in str(caught.value)
    assert path.read_text() == "earlier"
    assert names_in(tmp_path) == ["out.txt"]


def test_an_interrupted_write_leaves_nothing_behind(tmp_path, monkeypatch):
    def interrupt(descriptor):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "out.txt", "later")
    assert names_in(tmp_path) == []


def test_a_missing_folder_and_a_folder_in_the_way(tmp_path):
    with pytest.raises(LoopcloseError, match="No such file or directory"):
        write_atomically(tmp_path / "absent" / "out.txt", "")
    (tmp_path / "out.txt").mkdir()
    with pytest.raises(LoopcloseError, match=r"cannot write out\.txt"):
        write_atomically(tmp_path / "out.txt", "")
    assert names_in(tmp_path) == ["out.txt"]


def test_it_follows_the_convention_of_the_desktop(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "loopclose"


@pytest.mark.parametrize("value", ["", "not/absolute"])  # which the convention says to ignore
def test_without_a_usable_setting_it_is_under_the_home(monkeypatch, tmp_path, value):
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache" / "loopclose"

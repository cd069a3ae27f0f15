# SPDX-License-Identifier: Apache-2.0
import codecs
import errno
import os
import socket
from pathlib import Path

import pytest

from placerec.errors import LoopcloseError
from placerec.files import (
    cache_folder,
    is_file,
    is_folder,
    read_bytes,
    read_json,
    read_text,
    read_toml,
    write_atomically,
)


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


def test_no_home_is_one_line_that_tells_what_to_set(monkeypatch):
    def fail():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", fail)
    with pytest.raises(LoopcloseError, match="set XDG_CACHE_HOME"):
        cache_folder()


@pytest.mark.parametrize(
    ("mark", "encoding"),
    [
        (b"", "utf-8"),
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
        (codecs.BOM_UTF32_LE, "utf-32-le"),
        (codecs.BOM_UTF32_BE, "utf-32-be"),
    ],
)
def test_text_is_read_without_the_mark_of_its_encoding(tmp_path, mark, encoding):
    file = tmp_path / "list.txt"
    file.write_bytes(mark + "1.0 Weg/ä.png\r\n".encode(encoding))
    assert read_text(file) == "1.0 Weg/ä.png\r\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe\x80", r"binary\.txt is not text in UTF-8; save it as such"),
        ("Weg ä".encode("latin-1"), "not text in UTF-8"),
        (b"a\nb\0c", "not text: line 2 holds a NUL"),
        ("1 a.png".encode("utf-16-le"), "holds a NUL"),
        (b"12345", "larger than 0 MB"),
    ],
)
def test_what_is_no_text_is_one_line(tmp_path, content, message):
    file = tmp_path / "binary.txt"
    file.write_bytes(content)
    with pytest.raises(LoopcloseError, match=message) as caught:
        read_text(file, most_bytes=4 if content == b"12345" else 1000)
    assert str(caught.value).endswith(str(file))


def test_what_is_no_plain_file_is_refused_before_it_is_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
    for path in (tmp_path / "pipe", tmp_path / "socket", Path("/dev/zero")):
        with pytest.raises(LoopcloseError, match="a pipe, a device or a socket"):
            read_bytes(path)
    with pytest.raises(LoopcloseError, match="Is a directory"):
        read_bytes(tmp_path)


@pytest.mark.parametrize("name", ["gone", "x" * 300, "a\0b", "\ud800"])
def test_a_name_that_no_file_has_is_one_line(tmp_path, name):
    assert not is_file(tmp_path / name)
    assert not is_folder(tmp_path / name)
    with pytest.raises(LoopcloseError, match="cannot read "):
        read_bytes(tmp_path / name)


def test_a_file_of_more_bytes_than_it_says_is_not_read_to_its_end(tmp_path):
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 1 << 40)
    with pytest.raises(LoopcloseError, match="larger than 256 MB"):
        read_bytes(tmp_path / "sparse")
    with pytest.raises(LoopcloseError, match="larger than 0 MB"):
        read_bytes(Path("/proc/self/environ"), most_bytes=1)  # whose size is told as 0


DEEP, LONG = "[" * 200_000, "9" * 5000


@pytest.mark.parametrize("text", [DEEP, LONG, "{", "a", '{"a": '])
def test_broken_json_is_one_line(tmp_path, text):
    (tmp_path / "file.json").write_text(text)
    with pytest.raises(LoopcloseError, match=r"file\.json is not valid JSON"):
        read_json(tmp_path / "file.json")


@pytest.mark.parametrize("text", ["a = " + DEEP, f"a = {LONG}", "a", "a = 1\na = 2"])
def test_broken_toml_is_one_line(tmp_path, text):
    (tmp_path / "file.toml").write_text(text)
    with pytest.raises(LoopcloseError, match=r"file\.toml is not valid TOML"):
        read_toml(tmp_path / "file.toml")

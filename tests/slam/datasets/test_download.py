# SPDX-License-Identifier: Apache-2.0
import errno
import gzip
import io
import shutil
import tarfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from placerec.files import cache_folder
from slam.datasets import download, resolve
from slam.types import SlamError

NAME = "rgbd_dataset_freiburg1_desk"
URL_PATH = f"/freiburg1/{NAME}.tgz"


def tgz(files: dict[str, bytes], links: dict[str, str] | None = None) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
        for name, target in (links or {}).items():
            info = tarfile.TarInfo(name)
            info.type = tarfile.SYMTYPE
            info.linkname = target
            tar.addfile(info)
    return buffer.getvalue()


# Noise does not compress, so the archive is large enough to be cut in several places.
NOISE = np.random.default_rng(0).bytes(300_000)
ARCHIVE = tgz({f"{NAME}/rgb.txt": b"0.0 rgb/0.png\n", f"{NAME}/rgb/0.png": NOISE})


@dataclass
class Site:
    """What the server answers, and what it was asked."""

    content: bytes = ARCHIVE
    etag: str | None = '"v1"'
    knows_range: bool = True
    cut_after: list[int] = field(default_factory=list)  # per request: bytes sent before hanging up
    status: list[int] = field(default_factory=list)  # per request: errors instead of content
    requests: list[tuple[str, str | None, str | None]] = field(default_factory=list)
    url: str = ""


class Handler(BaseHTTPRequestHandler):
    site: Site

    def do_GET(self) -> None:
        site = self.site
        wanted = self.headers["Range"]
        site.requests.append((self.path, wanted, self.headers["If-Range"]))
        if site.status or self.path != URL_PATH:
            self.send_error(site.status.pop(0) if site.status else 404)
            return
        start = 0
        unchanged = self.headers["If-Range"] in (None, site.etag)
        if wanted and site.knows_range and unchanged:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        total = len(site.content)
        if start and start >= total:
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{total}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{total - 1}/{total}")
        if site.etag:
            self.send_header("ETag", site.etag)
        body = site.content[start:]
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: site.cut_after.pop(0)] if site.cut_after else body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Site]:
    site = Site()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("SiteHandler", (Handler,), {"site": site}))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    site.url = f"http://127.0.0.1:{server.server_address[1]}"
    monkeypatch.setenv("LOOPCLOSE_TUM_URL", site.url)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("LOOPCLOSE_DATA", raising=False)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(download, "_PAUSE_S", 0.0)
    yield site
    server.shutdown()
    server.server_close()
    thread.join()


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def assert_unpacked(folder: Path) -> None:
    assert folder == cache_folder() / NAME
    assert (folder / "rgb/0.png").read_bytes() == NOISE
    assert names_in(folder.parent) == [NAME]  # no archive, no part, no temporary folder


def test_a_whole_download_is_unpacked_and_reported(site: Site) -> None:
    seen: list[tuple[int, int | None]] = []
    assert_unpacked(resolve("fr1_desk", lambda done, total: seen.append((done, total))))
    assert seen[-1] == (len(ARCHIVE), len(ARCHIVE))
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_the_second_time_needs_no_server(site: Site) -> None:
    folder = resolve("fr1_desk")
    assert resolve("fr1_desk") == folder
    assert len(site.requests) == 1


def test_a_cut_connection_is_resumed_where_it_broke(site: Site) -> None:
    site.cut_after = [100_000, 50_000]
    assert_unpacked(resolve("fr1_desk"))
    assert [asked[1:] for asked in site.requests] == [
        (None, None),
        ("bytes=100000-", '"v1"'),
        ("bytes=150000-", '"v1"'),
    ]


def test_without_an_etag_the_download_resumes_too(site: Site) -> None:
    site.etag = None
    site.cut_after = [100_000]
    assert_unpacked(resolve("fr1_desk"))
    assert site.requests[1][1:] == ("bytes=100000-", None)


def test_a_server_without_ranges_restarts_cleanly(site: Site) -> None:
    site.knows_range = False
    site.cut_after = [100_000]
    assert_unpacked(resolve("fr1_desk"))


def test_a_file_that_changed_on_the_server_is_fetched_anew(site: Site) -> None:
    site.content = flipped(ARCHIVE, 500)
    site.cut_after = [1000] * download._TRIES
    with pytest.raises(SlamError):
        resolve("fr1_desk")
    site.content, site.etag = ARCHIVE, '"v2"'
    assert_unpacked(resolve("fr1_desk"))


def test_after_many_cuts_the_user_is_told_that_running_again_resumes(site: Site) -> None:
    site.cut_after = [1000] * download._TRIES
    with pytest.raises(SlamError, match="running again resumes") as caught:
        resolve("fr1_desk")
    assert "\n" not in str(caught.value)
    site.requests.clear()
    assert_unpacked(resolve("fr1_desk"))
    assert site.requests[0][1] == f"bytes={1000 * download._TRIES}-"


def test_a_part_that_was_already_whole_is_not_fetched_again(site: Site) -> None:
    part = cache_folder() / f"{NAME}.tgz.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(ARCHIVE)
    assert_unpacked(resolve("fr1_desk"))
    assert len(site.requests) == 1


def test_a_part_longer_than_the_file_is_dropped(site: Site) -> None:
    part = cache_folder() / f"{NAME}.tgz.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(ARCHIVE + b"more")
    assert_unpacked(resolve("fr1_desk"))


def test_a_server_that_is_busy_is_asked_again(site: Site) -> None:
    site.status = [503, 503]
    assert_unpacked(resolve("fr1_desk"))


def test_a_file_the_server_does_not_have_is_one_line_at_once(site: Site) -> None:
    site.status = [404]
    with pytest.raises(SlamError, match="HTTP 404"):
        resolve("fr1_desk")
    assert len(site.requests) == 1


def test_a_server_out_of_reach_is_one_line(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOOPCLOSE_TUM_URL", "http://127.0.0.1:9")
    with pytest.raises(SlamError, match="broke off"):
        resolve("fr1_desk")


def test_a_mirror_that_is_no_web_address_is_refused(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOOPCLOSE_TUM_URL", "ftp://example.org")
    with pytest.raises(SlamError, match="LOOPCLOSE_TUM_URL"):
        resolve("fr1_desk")


def flipped(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(ARCHIVE[: len(ARCHIVE) // 2], id="half"),
        pytest.param(ARCHIVE[:-4], id="checksum cut"),
        pytest.param(flipped(ARCHIVE, len(ARCHIVE) // 2), id="one byte flipped"),
        pytest.param(flipped(ARCHIVE, len(ARCHIVE) - 8), id="wrong checksum"),
        pytest.param(b"<html>no such file</html>", id="a web page"),
        pytest.param(b"", id="empty"),
    ],
)
def test_a_corrupted_archive_is_removed_and_nothing_unpacked(site: Site, content: bytes) -> None:
    site.content = content
    with pytest.raises(SlamError, match="removed"):
        resolve("fr1_desk")
    assert names_in(cache_folder()) == []
    site.content, site.etag = ARCHIVE, '"v2"'
    assert_unpacked(resolve("fr1_desk"))


@pytest.mark.parametrize(
    ("files", "links"),
    [
        ({"../evil": b"x"}, {}),
        ({f"{NAME}/../../evil": b"x"}, {}),
        ({"/evil": b"x"}, {}),
        ({"..\\evil": b"x"}, {}),
        ({}, {f"{NAME}/rgb": "../.."}),
        ({}, {f"{NAME}/rgb": "/etc"}),
    ],
)
def test_an_archive_that_reaches_out_of_its_folder_is_refused(
    site: Site, tmp_path: Path, files: dict[str, bytes], links: dict[str, str]
) -> None:
    site.content = tgz({f"{NAME}/rgb.txt": b"", **files}, links)
    with pytest.raises(SlamError, match="refused"):
        resolve("fr1_desk")
    assert names_in(cache_folder()) == []
    assert names_in(tmp_path) == ["cache"]
    assert not Path("/evil").exists()


def member(name: str, kind: bytes = tarfile.REGTYPE, size: int = 0) -> bytes:
    info = tarfile.TarInfo(name)
    info.type, info.size = kind, size
    return info.tobuf(tarfile.GNU_FORMAT)


END = bytes(1024)
SPARSE = bytearray(member(f"{NAME}/rgb.txt", tarfile.GNUTYPE_SPARSE))
SPARSE[386:410] = b"x" * 24  # where its numbers stand
SPARSE[148:156] = b"%06o\0 " % (256 + sum(SPARSE[:148]) + sum(SPARSE[156:]))


@pytest.mark.parametrize(
    ("members", "said"),
    [
        (bytes(SPARSE) + END, "removed"),
        (member(f"{NAME}/a", tarfile.GNUTYPE_SPARSE) + END, "neither a file nor a folder"),
        (member(f"{NAME}/{'x' * 300}") + END, "no file can have"),
        (2 * member(f"{NAME}/rgb.txt") + END, "twice"),
        (member(f"{NAME}/a") + member(f"{NAME}/a/b") + END, "twice"),
        (member("x", tarfile.GNUTYPE_LONGNAME, 3 << 30) + bytes(150 << 20), "far more comes out"),
        (member(f"{NAME}/a", size=150 << 20) + bytes(150 << 20) + END, "far more comes out"),
        (member(f"{NAME}/a") + END + bytes(150 << 20), "far more comes out"),
        (2000 * (member("x", tarfile.GNUTYPE_LONGNAME, 1) + bytes(512)) + END, "removed"),
        (member("x", tarfile.XHDTYPE, 512) + b"9" * 512 + END, "removed"),
    ],
)
def test_an_archive_that_is_made_to_do_harm_is_removed(
    site: Site, members: bytes, said: str
) -> None:
    site.content = gzip.compress(members, 1)
    with pytest.raises(SlamError, match=said):
        resolve("fr1_desk")
    assert not names_in(cache_folder())


@pytest.mark.parametrize(
    "answer",
    [
        b"200 OK\r\nContent-Length: abc\r\n\r\nxx",
        b"200 OK\r\nContent-Length: -5\r\n\r\nxx",
        b"200 OK\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\nxx",
        b"206 P\r\nContent-Range: bytes " + b"9" * 5000 + b"-9/10\r\n\r\nxx",
        b"206 P\r\nContent-Range: bytes 0-1/" + b"9" * 5000 + b"\r\n\r\nxx",
        b"416 R\r\nContent-Range: bytes */" + b"9" * 5000 + b"\r\n\r\n",
        b"302 F\r\nLocation: http://[::1\r\nContent-Length: 0\r\n\r\n",
        b"302 F\r\nLocation: file:///etc/passwd\r\nContent-Length: 0\r\n\r\n",
        b"302 F\r\nLocation: http://a b\r\nContent-Length: 0\r\n\r\n",
        b"302 F\r\nLocation: /\xff\xfe\r\nContent-Length: 0\r\n\r\n",
        b'200 OK\r\nETag: "\xff"\r\nContent-Length: 9\r\n\r\nxx',
        b"999 \x1b[31m\r\n\r\n",
        b"nonsense",
    ],
)
def test_an_odd_answer_of_a_server_is_one_line(
    site: Site, answer: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer_oddly(handler: BaseHTTPRequestHandler) -> None:
        handler.wfile.write(b"HTTP/1.1 " + answer)
        handler.close_connection = True

    monkeypatch.setattr(Handler, "do_GET", answer_oddly)
    for _ in range(2):  # the second time there may be a part to go on with
        with pytest.raises(SlamError) as caught:
            resolve("fr1_desk")
        assert str(caught.value).isprintable()


@pytest.mark.parametrize("url", ["http://[::1", "http://" + "a" * 300, "http://a b", "http://"])
def test_a_mirror_without_an_address_is_one_line(
    site: Site, monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    monkeypatch.setenv("LOOPCLOSE_TUM_URL", url)
    with pytest.raises(SlamError):
        resolve("fr1_desk")


def test_an_archive_without_a_sequence_is_refused(site: Site) -> None:
    site.content = tgz({"readme.txt": b"hello"})
    with pytest.raises(SlamError, match="a file rgb"):
        resolve("fr1_desk")


def no_space(*args: object, **options: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_disk_full_while_downloading_is_one_line(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", no_space)
        with pytest.raises(SlamError, match="No space left on device"):
            resolve("fr1_desk")
    assert_unpacked(resolve("fr1_desk"))


def test_a_disk_full_while_unpacking_keeps_the_download(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfileobj", no_space)
        with pytest.raises(SlamError, match="No space left on device"):
            resolve("fr1_desk")
    assert names_in(cache_folder()) == [f"{NAME}.tgz"]
    assert_unpacked(resolve("fr1_desk"))
    assert len(site.requests) == 1


def test_a_cache_folder_that_cannot_be_made_is_one_line(
    site: Site, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(SlamError, match="XDG_CACHE_HOME"):
        resolve("fr1_desk")


@pytest.mark.parametrize("local_name", [NAME, "fr1_desk"])
def test_a_local_copy_comes_before_the_server(
    site: Site, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, local_name: str
) -> None:
    local = tmp_path / "data" / local_name
    local.mkdir(parents=True)
    (local / "rgb.txt").write_text("")
    monkeypatch.setenv("LOOPCLOSE_DATA", str(tmp_path / "data"))
    assert resolve("fr1_desk") == local
    assert site.requests == []


def test_an_existing_folder_is_taken_as_it_is(site: Site, tmp_path: Path) -> None:
    assert resolve(str(tmp_path)) == tmp_path


def test_an_unknown_name_lists_the_close_ones(site: Site) -> None:
    with pytest.raises(SlamError, match="did you mean fr1_desk") as caught:
        resolve("fr1_dsk")
    assert "the folder of a recording" in str(caught.value)
    with pytest.raises(SlamError, match="fr1_desk"):
        resolve("/no/such/folder")
    with pytest.raises(SlamError, match="neither a folder nor"):
        resolve("x" * 5000)

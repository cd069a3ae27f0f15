# SPDX-License-Identifier: Apache-2.0
"""Sequences of the TUM RGB-D benchmark, found on disk or fetched from its server."""

import gzip
import http.client
import logging
import os
import re
import shutil
import tarfile
import tempfile
import time
import urllib.error
import urllib.request
import zlib
from pathlib import Path, PurePosixPath
from typing import IO, cast

from placerec.datasets.names import benchmark_folder, benchmark_name, did_you_mean, find_data
from placerec.files import Progress, cache_folder, check_file
from slam.types import SlamError

_SERVER = "https://cvg.cit.tum.de/rgbd/dataset"
_WEB = ("https://", "http://")
_TRIES = 5
_PAUSE_S = 0.5
_TIMEOUT_S = 30.0
_CHUNK_BYTES = 1 << 18
_MOST_BYTES = 1 << 35
"""Of a download; the largest of the benchmark's has a tenth."""
_MOST_UNPACKED = (4, 100 << 20)
"""Times the bytes of an archive, and so many more: images are compressed already."""
_TRY_AGAIN = frozenset({408, 425, 429, 500, 502, 503, 504})
_LENGTH = r"[0-9]{1,18}"
_EXTENT = rf"bytes ({_LENGTH})-{_LENGTH}/({_LENGTH}|\*)"
_LONGEST_NAME = 255
_CORRUPTED = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError)
_log = logging.getLogger(__name__)


def resolve(name_or_path: str, progress: Progress | None = None) -> Path:
    """Return the folder of a sequence: a path, or a benchmark name, downloaded if need be.

    A path or a name is looked for here, under $LOOPCLOSE_DATA, then, a benchmark name, in the
    user's cache folder, then on the benchmark's server (or the mirror $LOOPCLOSE_TUM_URL), whose
    archive goes to the cache folder.

    Raises:
        SlamError: it is neither a path nor a known name, or the download does not succeed.
    """
    found = find_data(name_or_path)
    if found is not None:
        return found
    short_name = benchmark_name(name_or_path)
    if short_name is None:
        raise SlamError(
            "there is neither a folder nor a sequence of the TUM RGB-D benchmark of this name;"
            f" {did_you_mean(name_or_path) or 'names look like fr1_desk;'}"
            f" the folder of a recording, or a bag, works too: {name_or_path}"
        )
    return _fetch(benchmark_folder(short_name), progress)


def _fetch(folder_name: str, progress: Progress | None) -> Path:
    server = os.environ.get("LOOPCLOSE_TUM_URL", _SERVER).rstrip("/")
    if not server.startswith(_WEB):
        raise SlamError(f"LOOPCLOSE_TUM_URL must start with https:// or http://: {server}")
    folder = cache_folder() / folder_name
    archive = cache_folder() / f"{folder_name}.tgz"
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SlamError(
            f"cannot make the cache folder (set XDG_CACHE_HOME to another): {error.strerror}:"
            f" {cache_folder()}"
        ) from error
    if not archive.exists():
        freiburg = folder_name.removeprefix("rgbd_dataset_").split("_")[0]
        _download(f"{server}/{freiburg}/{archive.name}", archive, progress)
    _unpack(archive, folder)
    _log.info("downloaded to %s", folder)
    return folder


class _ConnectionCutError(Exception):
    """The server could not be reached or stopped in the middle; trying again may help."""


def _download(url: str, target: Path, progress: Progress | None = None) -> None:
    """Download a URL to a file that appears only when complete; what arrived before is kept.

    An unfinished file is `target` with `.part` behind its name; the version of the file on the
    server that it belongs to stands beside it in `.version`.

    Raises:
        SlamError: the server has no such file, stays out of reach, or the disk is full.
    """
    part = target.with_name(target.name + ".part")
    version = target.with_name(target.name + ".version")
    for attempt in range(1, _TRIES + 1):
        try:
            _continue(url, part, version, progress)
            part.replace(target)
            version.unlink(missing_ok=True)
            return
        except _ConnectionCutError as error:
            _log.info("try %d of %d failed: %s", attempt, _TRIES, error)
            if attempt == _TRIES:
                at_hand = part.stat().st_size if part.exists() else 0
                raise SlamError(
                    f"the download broke off {_TRIES} times ({error}); {at_hand / 1e6:.1f} MB are"
                    f" kept and running again resumes there: {url}"
                ) from error
            time.sleep(_PAUSE_S * 2 ** (attempt - 1))
        except OSError as error:
            raise SlamError(f"cannot store the download: {error.strerror}: {part}") from error


def _continue(url: str, part: Path, version: Path, progress: Progress | None) -> None:
    """Ask for what is missing and append it; start anew where the server cannot go on there."""
    start = part.stat().st_size if part.exists() else 0
    headers = {"User-Agent": "loopclose"}
    if start:
        headers["Range"] = f"bytes={start}-"
        if version.exists():
            headers["If-Range"] = version.read_text(encoding="latin-1")
    response = _open(url, headers, part)
    if response is None:
        return
    with response:
        range_start, total = _extent(response)
        if range_start != start:
            if range_start:
                raise _start_anew(part, f"the server sent bytes from {range_start}, not {start}")
            start = 0
        _remember_version(response, version)
        with part.open("ab" if start else "wb") as file:
            while chunk := _chunk(response):
                if start > _MOST_BYTES:
                    raise SlamError(f"the server sends more than any sequence has: {url}")
                file.write(chunk)
                start += len(chunk)
                if progress:
                    progress(start, total)
    if total is not None and start != total:
        raise _ConnectionCutError(f"{start} of {total} bytes arrived")


def _open(url: str, headers: dict[str, str], part: Path) -> http.client.HTTPResponse | None:
    """Return the server's answer, or None where it says that nothing is missing."""
    try:
        request = urllib.request.Request(url, headers=headers)
        response: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=_TIMEOUT_S)
        if not response.url.startswith(_WEB):
            raise SlamError(f"the server leads to {response.url}, which is no web address: {url}")
        return response
    except urllib.error.HTTPError as error:
        why = f"HTTP {error.code} {error.reason}"
        if error.code == 416:  # there is nothing behind what is at hand
            if error.headers["Content-Range"] == f"bytes */{part.stat().st_size}":
                return None
            raise _start_anew(part, why) from error
        if error.code in _TRY_AGAIN:
            raise _ConnectionCutError(why) from error
        raise SlamError(f"the server refuses the download ({why}): {url}") from error
    except (OSError, http.client.HTTPException) as error:
        raise _ConnectionCutError(str(getattr(error, "reason", error)) or "no answer") from error
    except ValueError as error:  # urllib's about the address, or one that the server leads to
        raise SlamError(f"this is, or leads to, no web address ({error}): {url}") from error


def _start_anew(part: Path, why: str) -> _ConnectionCutError:
    part.unlink()
    return _ConnectionCutError(f"the unfinished file was removed because it did not fit: {why}")


def _extent(response: http.client.HTTPResponse) -> tuple[int, int | None]:
    """Return the first byte's position in the whole file, and the file's length where known."""
    if response.status == 206:
        extent = re.fullmatch(_EXTENT, response.headers["Content-Range"] or "")
        if extent is None:
            raise _ConnectionCutError("the server does not say which part it sends")
        return int(extent[1]), None if extent[2] == "*" else int(extent[2])
    length = response.headers["Content-Length"]
    if length and not re.fullmatch(_LENGTH, length):
        raise _ConnectionCutError("the server tells a length that is none")
    return 0, int(length) if length else None


def _remember_version(response: http.client.HTTPResponse, version: Path) -> None:
    tag = response.headers["ETag"] or ""
    if re.fullmatch(r'"[!-~]*"', tag):  # a weak tag (W/"...") may not be used to resume
        version.write_text(tag, encoding="latin-1")
    else:
        version.unlink(missing_ok=True)


def _chunk(response: http.client.HTTPResponse) -> bytes:
    """Return the next bytes, none at the end."""
    try:
        return response.read(_CHUNK_BYTES)
    except (OSError, http.client.HTTPException) as error:
        raise _ConnectionCutError(str(error) or "cut off") from error


def _unpack(archive: Path, folder: Path) -> None:
    """Unpack the one sequence in a .tgz as `folder`, whole or not at all, and remove the .tgz.

    Raises:
        SlamError: the archive is corrupted, holds a path or link that could leave the folder or
            no sequence, or the disk is full; a corrupted or refused archive is removed.
    """
    check_file(archive, _MOST_BYTES, kind=SlamError)
    try:
        with tempfile.TemporaryDirectory(
            dir=folder.parent, prefix=f".{folder.name}-"
        ) as unfinished:
            _extract(archive, Path(unfinished))
            _sequence_in(Path(unfinished)).replace(folder)
    except _CORRUPTED as error:
        archive.unlink()
        raise SlamError(
            f"the downloaded archive is corrupted ({error}) and was removed; run again to download"
            f" it anew: {archive}"
        ) from error
    except _RefusedError as error:
        archive.unlink()
        raise SlamError(f"the archive was refused and removed: {error}: {archive}") from error
    except OSError as error:
        raise SlamError(f"cannot unpack {archive.name}: {error.strerror}: {folder}") from error
    archive.unlink()


class _RefusedError(Exception):
    """Says what is wrong with an intact archive."""


class _Bounded:
    """A stream that ends in a refusal where more comes out of an archive than can be meant."""

    def __init__(self, stream: gzip.GzipFile, most_bytes: int) -> None:
        self._stream = stream
        self._left = most_bytes

    def read(self, size: int) -> bytes:
        chunk = self._stream.read(size)
        self._left -= len(chunk)
        if self._left < 0:
            raise _RefusedError("far more comes out of it than it has bytes")
        return chunk


def _extract(archive: Path, folder: Path) -> None:
    factor, more = _MOST_UNPACKED
    with gzip.open(archive) as packed:
        stream = _Bounded(packed, factor * archive.stat().st_size + more)
        try:
            _write_members(stream, folder)
        except (_RefusedError, OSError, *_CORRUPTED):
            raise
        except Exception as error:  # broken bytes lead tarfile anywhere
            raise tarfile.ReadError(type(error).__name__) from error
        # The checksum stands at the very end, behind what tar needs.
        while stream.read(1 << 20):
            pass


def _write_members(stream: _Bounded, folder: Path) -> None:
    with tarfile.open(fileobj=cast(IO[bytes], stream), mode="r|") as tar:
        for member in tar:
            target = folder / _safe_path(member)
            try:
                (target if member.isdir() else target.parent).mkdir(parents=True, exist_ok=True)
                if member.isdir():
                    continue
                content = tar.extractfile(member)
                assert content is not None  # regular files have content
                with target.open("xb") as file:
                    shutil.copyfileobj(content, file)
            except (FileExistsError, NotADirectoryError) as error:
                raise _RefusedError(f"it holds {member.name!r} twice") from error


def _safe_path(member: tarfile.TarInfo) -> PurePosixPath:
    # Only plain files and folders are written, so no link can redirect a later member.
    if not (member.isfile() or member.isdir()) or member.issparse():
        raise _RefusedError(f"it holds {member.name!r}, which is neither a file nor a folder")
    path = PurePosixPath(member.name)
    if path.is_absolute() or ".." in path.parts or "\\" in member.name or ":" in member.name:
        raise _RefusedError(f"it holds {member.name!r}, a path that could leave the target folder")
    if len(member.name.encode(errors="replace")) > _LONGEST_NAME or "\0" in member.name:
        raise _RefusedError(f"it holds {member.name!r}, a name that no file can have")
    return path


def _sequence_in(folder: Path) -> Path:
    found = [path.parent for path in folder.glob("*/rgb.txt")]
    if len(found) != 1:
        raise _RefusedError(f"it holds {len(found)} folders with a file rgb.txt, expected one")
    return found[0]

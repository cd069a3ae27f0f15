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

from placerec.datasets.names import benchmark_folder, benchmark_name, did_you_mean, find_data
from placerec.files import Progress, cache_folder
from slam.types import SlamError

_SERVER = "https://cvg.cit.tum.de/rgbd/dataset"

_TRIES = 5
_PAUSE_S = 0.5
_TIMEOUT_S = 30.0
_CHUNK_BYTES = 1 << 18
_TRY_AGAIN = frozenset({408, 425, 429, 500, 502, 503, 504})
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
    if not server.startswith(("https://", "http://")):
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
    request = urllib.request.Request(url, headers={"User-Agent": "loopclose"})
    if start:
        request.add_header("Range", f"bytes={start}-")
        if version.exists():
            request.add_header("If-Range", version.read_text())
    response = _open(request, part)
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
                file.write(chunk)
                start += len(chunk)
                if progress:
                    progress(start, total)
    if total is not None and start != total:
        raise _ConnectionCutError(f"{start} of {total} bytes arrived")


def _open(request: urllib.request.Request, part: Path) -> http.client.HTTPResponse | None:
    """Return the server's answer, or None where it says that nothing is missing."""
    url = request.full_url
    try:
        response: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=_TIMEOUT_S)
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


def _start_anew(part: Path, why: str) -> _ConnectionCutError:
    part.unlink()
    return _ConnectionCutError(f"the unfinished file was removed because it did not fit: {why}")


def _extent(response: http.client.HTTPResponse) -> tuple[int, int | None]:
    """Return the first byte's position in the whole file, and the file's length where known."""
    if response.status == 206:
        extent = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers["Content-Range"] or "")
        if extent is None:
            raise _ConnectionCutError("the server does not say which part it sends")
        return int(extent[1]), None if extent[2] == "*" else int(extent[2])
    length = response.headers["Content-Length"]
    return 0, int(length) if length else None


def _remember_version(response: http.client.HTTPResponse, version: Path) -> None:
    tag = response.headers["ETag"] or ""
    if tag.startswith('"'):  # a weak tag (W/"...") may not be used to resume
        version.write_text(tag)
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


def _extract(archive: Path, folder: Path) -> None:
    with gzip.open(archive) as stream:
        with tarfile.open(fileobj=stream, mode="r|") as tar:
            for member in tar:
                target = folder / _safe_path(member)
                if member.isdir():
                    target.mkdir(parents=True, exist_ok=True)
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                content = tar.extractfile(member)
                assert content is not None  # regular files have content
                with target.open("wb") as file:
                    shutil.copyfileobj(content, file)
        # The checksum stands at the very end, behind what tar needs.
        while stream.read(1 << 20):
            pass


def _safe_path(member: tarfile.TarInfo) -> PurePosixPath:
    # Only plain files and folders are written, so no link can redirect a later member.
    if not (member.isfile() or member.isdir()):
        raise _RefusedError(f"it holds {member.name!r}, which is neither a file nor a folder")
    path = PurePosixPath(member.name)
    if path.is_absolute() or ".." in path.parts or "\\" in member.name or ":" in member.name:
        raise _RefusedError(f"it holds {member.name!r}, a path that could leave the target folder")
    return path


def _sequence_in(folder: Path) -> Path:
    found = [path.parent for path in folder.glob("*/rgb.txt")]
    if len(found) != 1:
        raise _RefusedError(f"it holds {len(found)} folders with a file rgb.txt, expected one")
    return found[0]

# SPDX-License-Identifier: Apache-2.0
"""One file over HTTP, resumed where a cut connection left it."""

import http.client
import logging
import re
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from placerec.files import Progress
from slam.types import SlamError

_TRIES = 5
_PAUSE_S = 0.5
_TIMEOUT_S = 30.0
_CHUNK_BYTES = 1 << 18
_TRY_AGAIN = frozenset({408, 425, 429, 500, 502, 503, 504})
_log = logging.getLogger(__name__)


class _ConnectionCutError(Exception):
    """The server could not be reached or stopped in the middle; trying again may help."""


def download(url: str, target: Path, progress: Progress | None = None) -> None:
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
    """Ask for what is missing and append it; start anew where the server does not play along."""
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
            for chunk in _chunks(response):
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


def _chunks(response: http.client.HTTPResponse) -> Iterator[bytes]:
    while True:
        try:
            chunk = response.read(_CHUNK_BYTES)
        except (OSError, http.client.HTTPException) as error:
            raise _ConnectionCutError(str(error) or "cut off") from error
        if not chunk:
            return
        yield chunk

# SPDX-License-Identifier: Apache-2.0
"""A downloaded .tgz, checked while it is unpacked; nothing is written outside the target."""

import gzip
import shutil
import tarfile
import tempfile
import zlib
from pathlib import Path, PurePosixPath

from slam.types import SlamError

_CORRUPTED = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError)


def unpack(archive: Path, folder: Path) -> None:
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

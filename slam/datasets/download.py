# SPDX-License-Identifier: Apache-2.0
"""Short names of the TUM RGB-D benchmark's sequences, found on disk or fetched from its server."""

import gzip
import logging
import os
import shutil
import tarfile
import tempfile
import zlib
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path, PurePosixPath

from placerec.files import Progress, cache_folder
from slam.datasets.transfer import download
from slam.types import SlamError

_CORRUPTED = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError)


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


_SERVER = "https://cvg.cit.tum.de/rgbd/dataset"

_SEQUENCES = {
    "1": "360 desk desk2 floor plant room rpy teddy xyz",
    "2": "360_hemisphere 360_kidnap coke desk desk_with_person dishes flowerbouquet"
    " flowerbouquet_brownbackground large_no_loop large_with_loop metallic_sphere"
    " metallic_sphere2 pioneer_360 pioneer_slam pioneer_slam2 pioneer_slam3 rpy xyz",
    "3": "cabinet large_cabinet long_office_household nostructure_notexture_far"
    " nostructure_notexture_near_withloop nostructure_texture_far"
    " nostructure_texture_near_withloop sitting_halfsphere sitting_rpy sitting_static sitting_xyz"
    " structure_notexture_far structure_notexture_near structure_texture_far"
    " structure_texture_near teddy walking_halfsphere walking_rpy walking_static walking_xyz",
}
_SHORT_NAMES = tuple(f"fr{n}_{name}" for n, names in _SEQUENCES.items() for name in names.split())
_NICKNAMES = {
    "fr3_office": "fr3_long_office_household",
    "fr3_long_office": "fr3_long_office_household",
}
_log = logging.getLogger(__name__)


def resolve(name_or_path: str, progress: Progress | None = None) -> Path:
    """Return the folder of a sequence: a path, or a benchmark name, downloaded if need be.

    A name is looked for under $LOOPCLOSE_DATA, then in the user's cache folder, then on the
    benchmark's server (or the mirror $LOOPCLOSE_TUM_URL), whose archive goes to the cache folder.

    Raises:
        SlamError: it is neither a path nor a known name, or the download does not succeed.
    """
    with suppress(OSError):  # such as a name too long for a path
        if Path(name_or_path).exists():
            return Path(name_or_path)
    short_name = _short_name(name_or_path)
    folder_name = f"rgbd_dataset_freiburg{short_name[2:]}"
    for root in _local_roots():
        for candidate in (root / folder_name, root / short_name):
            if (candidate / "rgb.txt").is_file():
                return candidate
    return _fetch(folder_name, progress)


def _short_name(name: str) -> str:
    plain = name.lower().strip("/").replace("-", "_").replace("/", "_")
    plain = plain.removeprefix("rgbd_dataset_").replace("freiburg", "fr", 1)
    plain = _NICKNAMES.get(plain, plain)
    if plain in _SHORT_NAMES:
        return plain
    close = get_close_matches(plain, (*_SHORT_NAMES, *_NICKNAMES))
    hint = f"did you mean {' or '.join(close)}?" if close else "names look like fr1_desk;"
    raise SlamError(
        f"there is neither a folder nor a sequence of the TUM RGB-D benchmark of this name; {hint}"
        f" the folder of a recording works too: {name}"
    )


def _local_roots() -> list[Path]:
    data = os.environ.get("LOOPCLOSE_DATA")
    return [*([Path(data)] if data else []), cache_folder()]


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
        download(f"{server}/{freiburg}/{archive.name}", archive, progress)
    _unpack(archive, folder)
    _log.info("downloaded to %s", folder)
    return folder

# SPDX-License-Identifier: Apache-2.0
"""The folder of a map: complete whenever its manifest says so, which is replaced at once.

The arrays lie in a folder named by their content, beside those of the map before, until the
manifest, one small file, names the new ones. So whoever is killed leaves the old map or the new.
"""

import hashlib
import json
import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from placerec.certificate import fingerprint
from placerec.errors import cause_of, printable
from placerec.files import is_file, read_json, write_atomically
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.loops.saved_map import SavedMap
from slam.output.claimed_folder import locked, sync
from slam.output.decision import Decision, decisions
from slam.output.ledger.writing import ledger_line
from slam.output.map_folder.array_files import (
    mapped_array,
    measure_file,
    npy_parts,
    write_file,
)
from slam.output.map_folder.arrays import cameras_of, columns_of, map_of
from slam.result import SlamResult
from slam.system import Slam
from slam.types import Camera, SlamError

VERSION = 2
"""Of the layout: larger whenever a reader of the one before would be misled."""

_OLDEST = 1  # of one camera
_FORMAT = "loopclose map"
MANIFEST = "manifest.json"
"""Makes a folder a map; written last."""

_LEDGER = "loops.jsonl"
_ARRAYS, _PART = "arrays-", ".part-"  # a finished folder of arrays, and one that is being written
_ANOTHER = "choose another folder"
_DAMAGED = "load another copy of it, or make the map again"

_Files = dict[str, dict[str, int]]


def saved_map(slam: Slam, result: SlamResult) -> SavedMap:
    """Return the map of a run that is finished, with every loop decision about it.

    It has the keyframes that have a place, numbered anew where there are others.

    Raises:
        SlamError: the run was finished without its images.
        RecognizerError: the recognizer has neither a fingerprint nor a source file.
    """
    saved, earlier = slam.saved(result), slam.earlier
    placed = np.flatnonzero(np.isfinite(result.T_world_kf[:, 0, 0]))
    number = dict(zip(placed.tolist(), range(len(placed)), strict=True))
    lines = []
    for each in decisions(result, None)[len(earlier.attempts) if earlier else 0 :]:
        query_id, match_id = each.attempt.query_id, each.attempt.match_id
        if query_id in number and match_id in number:
            numbered = replace(each.attempt, query_id=number[query_id], match_id=number[match_id])
            lines.append(line_of(replace(each, attempt=numbered), result.min_similarity))
    return replace(saved, ledger=(*(earlier.ledger if earlier else ()), *lines))


def line_of(decision: Decision, min_similarity: float) -> str:
    """Return a decision's line of a map's ledger, without what it did to the keyframes of a run."""
    attempt = replace(decision.attempt, influence=None)
    return ledger_line(replace(decision, attempt=attempt), min_similarity)


def check_place(folder: Path, recognizer: PlaceRecognizer) -> None:
    """Refuse early what `save_map` would refuse in the end.

    Raises:
        SlamError: the folder cannot be written to, or holds something that is no map.
        RecognizerError: the recognizer has neither a fingerprint nor a source file.
    """
    fingerprint(recognizer)
    _refuse_foreign(folder)
    above = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise SlamError(f"cannot write the map here; {_ANOTHER}: {folder}")


def save_map(folder: Path, saved: SavedMap) -> None:
    """Write a map, in the place of one that is there; until it is complete, that one stays.

    The same map always gives the same bytes.

    Raises:
        SlamError: the folder holds something else, another process is writing to it, or it cannot
            be written; a map that was there still is.
    """
    _refuse_foreign(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = locked(folder, f"the map; wait until it is over, or {_ANOTHER}")
    except OSError as error:
        raise SlamError(f"cannot write the map: {error.strerror}: {folder}") from error
    part = folder / f"{_PART}{os.getpid()}"
    try:
        files = _write_arrays(part, saved)
        name = f"{_ARRAYS}{_digest(files)}"
        if (folder / name).exists() and _wrong_file(folder / name, files):
            shutil.rmtree(folder / name)  # damaged: no map is lost
        if not (folder / name).exists():
            part.replace(folder / name)
        sync(folder)
        write_atomically(folder / MANIFEST, _told(saved, name, files))
        sync(folder)
        _tidy(folder, name)
    except OSError as error:
        raise SlamError(
            f"cannot write the map: {error.strerror}; free the space, or {_ANOTHER}: {folder}"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        os.close(lock)


def load_map(folder: Path, recognizer: PlaceRecognizer, config: Config | None = None) -> SavedMap:
    """Read a map back; what takes most of its room stays in its files until it is needed.

    Every file is compared with its checksum first.

    Raises:
        SlamError: it is missing, damaged, of another version, or its places were embedded by
            another recognizer.
        RecognizerError: the recognizer has neither a fingerprint nor a source file.
    """
    manifest = _read_manifest(folder)
    if manifest["fingerprint"] != fingerprint(recognizer):
        raise SlamError(
            "the places of this map were embedded by another recognizer, whose embeddings cannot be"
            f" compared with those of {type(recognizer).__name__!r}; load it with the one that made"
            f" it, or embed it anew with run_slam reembed: {folder}"
        )
    return _read(folder, manifest, config)


def read_map(folder: Path, config: Config | None = None) -> SavedMap:
    """Read a map back, whatever recognizer embedded its places, as `load_map` does.

    Raises:
        SlamError: it is missing, damaged or of another version.
    """
    return _read(folder, _read_manifest(folder), config)


def _read(folder: Path, manifest: dict[str, Any], config: Config | None) -> SavedMap:
    files: _Files = manifest["files"]
    inside = folder / manifest["arrays"]
    if wrong := _wrong_file(inside, files):
        raise SlamError(f"{wrong} of the map is missing or damaged; {_DAMAGED}: {folder}")
    try:
        arrays = {
            name.removesuffix(".npy"): mapped_array(inside / name)
            for name in files
            if name.endswith(".npy")
        }
        cameras = [
            Camera(**{**each, "distortion": tuple(each["distortion"])})
            for each in manifest.get("cameras", [manifest.get("camera")])
        ]
        ledger = (inside / _LEDGER).read_text(encoding="utf-8").splitlines()
        return map_of(arrays, cameras, manifest["fingerprint"], config or Config(), ledger)
    except Exception as error:  # whatever arrays that do not fit each other lead to
        raise SlamError(f"the map is damaged ({cause_of(error)}); {_DAMAGED}: {folder}") from error


def _write_arrays(part: Path, saved: SavedMap) -> _Files:
    """Write all files but the manifest into a new folder, and return their sizes and checksums."""
    shutil.rmtree(part, ignore_errors=True)  # of a process of the same number, long ago
    part.mkdir()
    files = {
        f"{name}.npy": write_file(part / f"{name}.npy", npy_parts(*column))
        for name, column in sorted(columns_of(saved).items())
    }
    ledger = "".join(f"{line}\n" for line in saved.ledger)
    files[_LEDGER] = write_file(part / _LEDGER, [ledger.encode()])
    sync(part)
    return files


def _digest(files: _Files) -> str:
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:16]


def _told(saved: SavedMap, name: str, files: _Files) -> str:
    manifest = {
        "format": _FORMAT,
        "version": VERSION,
        "fingerprint": saved.fingerprint,
        "cameras": [asdict(each) for each in cameras_of(saved)],
        "keyframes": len(saved.keyframes),
        "arrays": name,
        "files": files,
    }
    return json.dumps(manifest, indent=2) + "\n"


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Return what the manifest says, as far as it has to be of its kind.

    Raises:
        SlamError: there is none, it is damaged, or of another version.
    """
    path = folder / MANIFEST
    if not is_file(path):
        raise SlamError(f"there is no map in this folder, which would have a {MANIFEST}: {folder}")
    manifest = read_json(path, kind=SlamError)
    if not isinstance(manifest, dict) or manifest.get("format") != _FORMAT:
        raise SlamError(f"this is no manifest of a map: {path}")
    if (version := manifest.get("version")) not in range(_OLDEST, VERSION + 1):
        raise SlamError(
            f"the map is of version {version}, and this reads {VERSION}; load it with the loopclose"
            f" that wrote it, or make the map again: {folder}"
        )
    of_cameras: dict[str, type] = {"camera": dict} if version == _OLDEST else {"cameras": list}
    kinds = {"fingerprint": str, **of_cameras, "arrays": str, "files": dict}
    if any(not isinstance(manifest.get(name), kind) for name, kind in kinds.items()):
        raise SlamError(f"the manifest of the map is damaged; {_DAMAGED}: {folder}")
    names = (manifest["arrays"], *manifest["files"])
    is_ours = names[0].startswith(_ARRAYS) and _LEDGER in names
    if not is_ours or any(Path(name).name != name for name in names):
        raise SlamError(f"the manifest of the map is damaged; {_DAMAGED}: {folder}")
    return manifest


def _wrong_file(inside: Path, files: _Files) -> str | None:
    """Return the name of the first file that is missing or not as it was written."""
    for name, written in files.items():
        try:
            if measure_file(inside / name) != written:
                return printable(name)
        except (OSError, ValueError):  # no file can have this name
            return printable(name)
    return None


def _refuse_foreign(folder: Path) -> None:
    """Refuse a folder that holds something else than a map, or what saving one has left.

    Raises:
        SlamError: it does, or is no folder.
    """
    try:
        names = [each.name for each in folder.iterdir()] if folder.exists() else []
    except OSError as error:
        raise SlamError(f"cannot save a map here: {error.strerror}: {folder}") from error
    known = (MANIFEST, f".{MANIFEST}.")
    foreign = [each for each in sorted(names) if not each.startswith((*known, _ARRAYS, _PART))]
    if foreign:
        raise SlamError(
            f"the folder to save the map in holds a {foreign[0]}, which is of no map; {_ANOTHER}:"
            f" {folder}"
        )


def _tidy(folder: Path, name: str) -> None:
    """Remove the arrays of the map before, and what saving has left when it was killed."""
    for each in folder.iterdir():
        if each.name.startswith((_ARRAYS, _PART)) and each.name != name:
            shutil.rmtree(each, ignore_errors=True)
        elif each.name.startswith(f".{MANIFEST}."):
            each.unlink(missing_ok=True)

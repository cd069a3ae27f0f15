# SPDX-License-Identifier: Apache-2.0
"""Which format a folder of images is in.

Every reader of a format raises LoopcloseError where a list, a table or the truth cannot be used, or
most images are broken.
"""

import re
from collections.abc import Callable
from pathlib import Path

from placerec.datasets.clips import PARTS, read_clips
from placerec.datasets.frame_pairs import read_drives, read_frame_pairs
from placerec.datasets.names import benchmark_name, did_you_mean, find_data
from placerec.datasets.oxford import find_ground_truth, read_oxford
from placerec.datasets.place_dataset import PlaceDataset
from placerec.datasets.tum import read_tum, read_tum_sessions
from placerec.datasets.tum_lists import as_whole_number
from placerec.errors import RecognizerError
from placerec.files import is_file, is_folder


def open_dataset(source: str, part: str = "test") -> PlaceDataset:
    """Open a folder in any known format, a part of one, or one folder against another.

    Args:
        source: FOLDER; FOLDER:PART of one of clips; or QUERY+REFERENCE, two recordings in one
            world or, as QUERY+REFERENCE:FRAMES, two folders of images with a tolerance. A folder
            may also be named as `find_data` takes it.
        part: of a folder of clips, where the source names none.

    Raises:
        LoopcloseError: there is no such folder or part, it is in no known format, or it is broken.
    """
    try:
        sessions = _split_sessions(source)
        return _read_sessions(*sessions) if sessions else _read_folder(source, part)
    except OSError as error:
        raise RecognizerError(f"cannot look into the folder: {error.strerror}: {source}") from error


def open_collection(source: str, part: str = "test") -> list[PlaceDataset]:
    """Open a dataset, or all datasets in a folder of such folders.

    Raises:
        LoopcloseError: as `open_dataset`, of any of them.
    """
    try:
        folder = _located(source)
        inner = sorted(path for path in folder.glob("[!.]*") if path.is_dir())
        if _is_dataset(folder) or not any(_is_dataset(path) for path in inner):
            return [open_dataset(source, part)]
    except OSError as error:
        raise RecognizerError(f"cannot look into the folder: {error.strerror}: {source}") from error
    return [open_dataset(str(path), part) for path in inner]


def _is_dataset(folder: Path) -> bool:
    return _holds_clips(folder) or _reader_of_whole(folder) is not None


def _holds_clips(folder: Path) -> bool:
    return is_file(folder / "dataset.csv")


def _reader_of_whole(folder: Path) -> Callable[[Path], PlaceDataset] | None:
    """Return what reads a folder that has no parts, by what it holds."""
    if is_file(folder / "rgb.txt"):
        return read_tum
    if is_folder(folder / "query"):
        return read_frame_pairs
    return read_oxford if find_ground_truth(folder) is not None else None


def _read_folder(source: str, part: str) -> PlaceDataset:
    folder, named = _split(source)
    if not is_folder(folder):
        raise _absent(source)
    if _holds_clips(folder):
        return read_clips(folder, named or part)
    if named:
        raise RecognizerError(f"only a folder of clips has parts, no {named!r} here: {folder}")
    reader = _reader_of_whole(folder)
    if reader is not None:
        return reader(folder)
    raise RecognizerError(
        "the folder is in no known format: rgb.txt and groundtruth.txt (TUM RGB-D), query/ and "
        "ref/ (image pairs), Images/ and ...GroundTruth.mat (New College, City Centre), or "
        f"dataset.csv and images/ (clips, with the parts {', '.join(PARTS)}): {folder}"
    )


def _read_sessions(queries: Path, references: Path, tolerance: str | None) -> PlaceDataset:
    for folder in (queries, references):
        if not is_folder(folder):
            raise _absent(str(folder))
    if queries.resolve() == references.resolve():
        raise RecognizerError(f"both sides of + are one folder; name it once, alone: {queries}")
    are_recordings = [is_file(folder / "rgb.txt") for folder in (queries, references)]
    if all(are_recordings) and tolerance is None:
        return read_tum_sessions(queries, references)
    if any(are_recordings):
        raise RecognizerError(
            "+ takes two TUM RGB-D recordings, or two folders of images and a tolerance in frames "
            f"(QUERY+REFERENCE:2): {queries} and {references}"
        )
    if tolerance is None:
        return read_drives(queries, references)
    frames = as_whole_number(tolerance)
    if frames is None:
        raise RecognizerError(f"the tolerance is a number of frames from 0, not {tolerance!r}")
    return read_drives(queries, references, frames)


def _absent(source: str) -> RecognizerError:
    short_name = benchmark_name(source)
    if short_name:
        return RecognizerError(
            f"this sequence is not at hand; `run_slam {short_name}` fetches it, or set"
            f" LOOPCLOSE_DATA to the folder that it is in: {source}"
        )
    hint = f"; {question}" if (question := did_you_mean(source)) else ""
    return RecognizerError(f"there is no such folder{hint}: {source}")


def _located(source: str) -> Path:
    return find_data(source) or Path(source)


def _split_sessions(source: str) -> tuple[Path, Path, str | None] | None:
    """Return both folders and what follows a colon; None where the source is one folder."""
    if is_folder(_split(source)[0]):
        return None
    for plus in re.finditer(re.escape("+"), source):
        queries, references = source[: plus.start()], source[plus.end() :]
        if is_folder(_located(queries)):
            return _located(queries), *_split(references)
    return None


def _split(source: str) -> tuple[Path, str | None]:
    folder, colon, part = source.rpartition(":")
    if not colon or find_data(source) or not is_folder(_located(folder)):
        return _located(source), None
    return _located(folder), part

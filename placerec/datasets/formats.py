# SPDX-License-Identifier: Apache-2.0
"""Which format a folder of images is in."""

from pathlib import Path

from placerec.datasets.clips import PARTS, read_clips
from placerec.datasets.frame_pairs import read_frame_pairs
from placerec.datasets.oxford import find_ground_truth, read_oxford
from placerec.datasets.place_dataset import PlaceDataset
from placerec.datasets.tum import read_tum
from placerec.recognizer import RecognizerError


def open_dataset(source: str, part: str = "test") -> PlaceDataset:
    """Open a folder in any known format, as FOLDER or, for one of clips, as FOLDER:PART.

    Args:
        source: the folder, with or without a part.
        part: of a folder of clips, where the source names none.

    Raises:
        RecognizerError: there is no such folder or part, it is in no known format, or it is broken.
    """
    folder, named = _split(source)
    if not folder.is_dir():
        raise RecognizerError(f"there is no such folder: {folder}")
    try:
        if (folder / "dataset.csv").is_file():
            return read_clips(folder, named or part)
        if named:
            raise RecognizerError(f"only a folder of clips has parts, no {named!r} here: {folder}")
        return _read_whole(folder)
    except OSError as error:
        raise RecognizerError(f"cannot look into the folder: {error.strerror}: {folder}") from error


def _split(source: str) -> tuple[Path, str | None]:
    folder, colon, part = source.rpartition(":")
    if not colon or Path(source).exists() or not Path(folder).is_dir():
        return Path(source), None
    return Path(folder), part


def _read_whole(folder: Path) -> PlaceDataset:
    if (folder / "rgb.txt").is_file():
        return read_tum(folder)
    if (folder / "query").is_dir():
        return read_frame_pairs(folder)
    if find_ground_truth(folder) is not None:
        return read_oxford(folder)
    raise RecognizerError(
        "the folder is in no known format: rgb.txt and groundtruth.txt (TUM RGB-D), query/ and "
        "ref/ (image pairs), Images/ and ...GroundTruth.mat (New College, City Centre), or "
        f"dataset.csv and images/ (clips, with the parts {', '.join(PARTS)}): {folder}"
    )

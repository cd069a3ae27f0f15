# SPDX-License-Identifier: Apache-2.0
"""Two drives of one path, whose frames match with a tolerance: query and ref, or any folders."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import images_in
from placerec.datasets.place_dataset import PlaceDataset, check_images, keep_readable
from placerec.datasets.tables import read_csv
from placerec.datasets.tum_lists import as_whole_number
from placerec.errors import RecognizerError

_TOLERANCE_FRAMES = 2


def read_frame_pairs(folder: Path, tolerance_frames: int = _TOLERANCE_FRAMES) -> PlaceDataset:
    """Read a folder with the images of two drives in query/ and ref/.

    Which frames match is read from ground_truth.csv (query,refs with refs as in 0;1;2, both
    counted from 0); without that file, frames match whose numbers differ by the tolerance or less.
    """
    queries, references = (_images(folder / drive) for drive in ("query", "ref"))
    check_images((*queries, *references), folder.resolve().name)
    table = folder / "ground_truth.csv"
    if table.is_file():
        same_place = _read_matches(table, len(queries), len(references))
    else:
        same_place = _within(tolerance_frames, len(queries), len(references))
    return _pair(folder.resolve().name, queries, references, same_place)


def read_drives(
    query_folder: Path, reference_folder: Path, tolerance_frames: int = _TOLERANCE_FRAMES
) -> PlaceDataset:
    """Read two folders of images, taken at the same pace; numbers within the tolerance match."""
    queries, references = images_in(query_folder), images_in(reference_folder)
    for folder, images in ((query_folder, queries), (reference_folder, references)):
        if not images:
            raise RecognizerError(f"there is no image in the folder: {folder}")
    name = f"{query_folder.resolve().name}+{reference_folder.resolve().name}"
    check_images((*queries, *references), name)
    same_place = _within(tolerance_frames, len(queries), len(references))
    return _pair(name, queries, references, same_place)


def _within(tolerance_frames: int, queries: int, references: int) -> NDArray[np.bool_]:
    steps = np.arange(queries)[:, None] - np.arange(references)
    return np.asarray(np.abs(steps) <= tolerance_frames)


def _pair(
    name: str, queries: list[Path], references: list[Path], same_place: NDArray[np.bool_]
) -> PlaceDataset:
    dataset = PlaceDataset(
        name=name,
        paths=(*queries, *references),
        queries=np.arange(len(queries)),
        references=len(queries) + np.arange(len(references)),
        same_place=same_place,
        comparable=np.ones_like(same_place),
    )
    return keep_readable(dataset)


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise RecognizerError(f"there is no folder {folder.name}: {folder}")
    return images_in(folder)


def _read_matches(table: Path, queries: int, references: int) -> NDArray[np.bool_]:
    same_place = np.zeros((queries, references), dtype=np.bool_)
    for line, (query, matches) in read_csv(table, ("query", "refs")):
        numbers = [as_whole_number(each) for each in (query, *filter(None, matches.split(";")))]
        known = [number for number in numbers if number is not None]
        if len(known) < len(numbers):
            raise RecognizerError(f'line {line} is not "query,ref;ref;...": {table}')
        row, *columns = known
        if row >= queries or max(columns, default=0) >= references:
            raise RecognizerError(
                f"line {line} names an image that is not there: query/ has {queries} and ref/ "
                f"{references}, counted from 0: {table}"
            )
        same_place[row, columns] = True
    return same_place

# SPDX-License-Identifier: Apache-2.0
"""Clips filmed on the floors of a building (ie_tower): dataset.csv and one image per frame."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.place_dataset import PlaceDataset, check_images, keep_readable
from placerec.datasets.tables import read_csv
from placerec.datasets.tum_lists import as_whole_number, slashed
from placerec.errors import RecognizerError
from placerec.files import is_file

TEST_FLOORS = frozenset({"basement3", "floor6", "floor11", "floor16", "floor21"})
VALIDATION_FLOORS = frozenset({"basement0", "floor9", "floor19"})
"""Whole floors, spread over the building without looking at any result: of all 25 from the lowest
to the highest, every fifth from the third is for testing, every tenth from the first for
validation. The table's own split is a stride over the same clips and is not used: neighbouring
frames, nearly equal, would be on both sides."""
PARTS = ("train", "validation", "test")
_PLACE_FRAMES = 3
"""So many consecutive frames of a clip, about a second apart, share a view: a place."""

_FRAME = re.compile(r"(?P<clip>.+)_frame_(?P<number>\d+)\.\w+")


class Frame(NamedTuple):
    """One image: the floor it was filmed on, its clip and its number in that."""

    floor: str
    clip: str
    number: int
    path: Path


def read_clips(folder: Path, part: str = "test") -> PlaceDataset:
    """Read the floors for training, validation or testing of a folder with dataset.csv and images.

    Frames of one clip fewer than 3 frames apart are the same place, those of different floors
    are different ones. All other pairs of one floor are not compared: clips cross each other and
    come back, so nobody knows. A label is 3 consecutive frames; what is left at the end
    of a clip joins the last.
    """
    if part not in PARTS:
        raise RecognizerError(f"there is no part {part!r}; there are: {', '.join(PARTS)}")
    frames = sorted(frame for frame in _read_frames(folder) if _part(frame.floor) == part)
    if not frames:
        raise RecognizerError(f"no image is of a floor for {part}: {folder}")
    name = f"{folder.resolve().name}:{part}"
    check_images([frame.path for frame in frames], name)
    floors = np.array([frame.floor for frame in frames])
    clips = np.array([frame.clip for frame in frames])
    numbers = np.array([frame.number for frame in frames])
    apart = np.abs(numbers[:, None] - numbers)
    same_place = (clips[:, None] == clips) & (apart < _PLACE_FRAMES) & (apart > 0)
    everyone = np.arange(len(frames))
    dataset = PlaceDataset(
        name=name,
        paths=tuple(frame.path for frame in frames),
        queries=everyone,
        references=everyone,
        same_place=same_place,
        comparable=same_place | (floors[:, None] != floors),
        places=_label(clips),
    )
    return keep_readable(dataset)


def _part(floor: str) -> str:
    if floor in TEST_FLOORS:
        return "test"
    return "validation" if floor in VALIDATION_FLOORS else "train"


def _read_frames(folder: Path) -> list[Frame]:
    table = folder / "dataset.csv"
    frames = []
    for line, (path, floor) in read_csv(table, ("image_path", "floor")):
        path = path if is_file(folder / path) else slashed(path)
        match = _FRAME.fullmatch(Path(path).name)
        number = as_whole_number(match["number"]) if match else None
        if match is None or number is None:
            raise RecognizerError(
                f"line {line} names {Path(path).name!r}, not like clip_frame_000001.jpg: {table}"
            )
        clip = f"{floor}/{match['clip']}"
        frames.append(Frame(floor, clip, number, folder / path))
    return frames


def _label(clips: NDArray[np.str_]) -> NDArray[np.int64]:
    """Return labels that count up from 0, of frames in the order of their clips."""
    labels = np.empty(len(clips), np.int64)
    count = 0
    for clip in np.unique(clips):
        own = clips == clip
        places = max(1, int(own.sum()) // _PLACE_FRAMES)
        labels[own] = count + np.minimum(np.arange(own.sum()) // _PLACE_FRAMES, places - 1)
        count += places
    return labels

# SPDX-License-Identifier: Apache-2.0
"""What the commands share: opening the datasets that they are given, and the progress bar."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tqdm import tqdm

from placerec.datasets import PlaceDataset, open_collection, open_dataset
from placerec.datasets.images import images_in
from placerec.datasets.place_dataset import keep_readable
from placerec.files import Progress

Data = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="DATA ...", help_behavior_hint="(at least one)"),
]
RECOGNIZER = "NAME|MODULE:CLASS|FILE"
"""How the helps write what `load` takes."""


def open_data(source: str, part: str = "test") -> PlaceDataset:
    """Open a dataset and name the images of it that cannot be read.

    Raises:
        RecognizerError: it cannot be opened.
    """
    return _name_skipped(open_dataset(source, part))


def open_all(source: str, part: str) -> list[PlaceDataset]:
    """Open a dataset, or all in a folder of such folders, likewise.

    Raises:
        RecognizerError: one cannot be opened.
    """
    return [_name_skipped(dataset) for dataset in open_collection(source, part)]


def open_images(source: str) -> PlaceDataset:
    """Open a dataset to learn from without its truth, or just a folder of images, likewise.

    Raises:
        RecognizerError: it cannot be opened.
    """
    folder = Path(source)
    paths = tuple(images_in(folder)) if folder.is_dir() else ()
    if not paths:
        return open_data(source, "train")
    # No query and no reference: nothing is compared.
    nobody, nothing = np.empty(0, np.int64), np.empty((0, 0), np.bool_)
    dataset = PlaceDataset(folder.resolve().name, paths, nobody, nobody, nothing, nothing)
    return _name_skipped(keep_readable(dataset))


def _name_skipped(dataset: PlaceDataset) -> PlaceDataset:
    for broken in dataset.skipped:
        print(f"placerec: skipped: {broken.why}: {broken.path}", file=sys.stderr)
    return dataset


@contextmanager
def progress_bar(title: str, total: int, unit: str = "image") -> Iterator[Progress]:
    """Show a bar while what is inside tells how much is done."""
    # disable=None: no bar where nobody watches, as in a file.
    with tqdm(desc=title, total=total, unit=unit, leave=False, disable=None) as bar:
        yield lambda done, _: bar.update(done - bar.n)

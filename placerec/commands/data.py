# SPDX-License-Identifier: Apache-2.0
"""The datasets that commands are given: opened, described, embedded before people's eyes."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from placerec.datasets import PlaceDataset, open_collection, open_dataset
from placerec.datasets.images import images_in
from placerec.datasets.place_dataset import keep_readable
from placerec.evaluation.embeddings import embed_dataset
from placerec.files import Progress
from placerec.recognizer import PlaceRecognizer

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


def embed_data(
    name: str, recognizer: PlaceRecognizer, dataset: PlaceDataset
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the (N, *S) embeddings of a dataset and the (N,) seconds each took, under a bar.

    Raises:
        RecognizerError: the recognizer fails, or an image can no longer be read.
    """
    with progress_bar(f"{name} on {dataset.name}", len(dataset)) as progress:
        embedded = embed_dataset(recognizer, dataset, progress=progress)
    return embedded.embeddings, embedded.seconds

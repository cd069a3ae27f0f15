# SPDX-License-Identifier: Apache-2.0
"""What the commands share: opening the datasets that they are given."""

import logging
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from placerec.datasets import PlaceDataset, open_dataset
from placerec.datasets.images import images_in
from placerec.datasets.names import find_data
from placerec.datasets.place_dataset import keep_readable
from placerec.files import is_folder

Data = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="DATA ...", help_behavior_hint="(at least one)"),
]
RECOGNIZER = "NAME|MODULE:CLASS|FILE"
"""How the helps write what `load` takes."""
_log = logging.getLogger("placerec")


def open_data(source: str, part: str = "test") -> PlaceDataset:
    """Open a dataset and name the images of it that cannot be read.

    Raises:
        RecognizerError: it cannot be opened.
    """
    return with_skipped_named(open_dataset(source, part))


def open_images(source: str, part: str) -> PlaceDataset:
    """Open just a folder of images, or else a dataset, for what asks for no truth.

    Raises:
        RecognizerError: it is neither, or cannot be opened.
    """
    folder = find_data(source) or Path(source)
    paths = images_in(folder) if is_folder(folder) else []
    return without_truth(folder.resolve().name, paths) if paths else open_data(source, part)


def without_truth(
    name: str, paths: list[Path], timestamps_s: NDArray[np.float64] | None = None
) -> PlaceDataset:
    """Return images of which none looks for its place, and name those that cannot be read.

    Raises:
        RecognizerError: most of them cannot, or there is none.
    """
    nobody, nothing = np.empty(0, np.int64), np.empty((0, 0), np.bool_)
    images = PlaceDataset(
        name, tuple(paths), nobody, nobody, nothing, nothing, timestamps_s=timestamps_s
    )
    return with_skipped_named(keep_readable(images))


def with_skipped_named(dataset: PlaceDataset) -> PlaceDataset:
    """Return a dataset, and name the images of it that cannot be read."""
    for broken in dataset.skipped:
        _log.warning("skipped: %s: %s", broken.why, broken.path)
    return dataset

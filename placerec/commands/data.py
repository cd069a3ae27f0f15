# SPDX-License-Identifier: Apache-2.0
"""What the commands share: opening the datasets that they are given."""

import logging
from typing import Annotated

import tyro

from placerec.datasets import PlaceDataset, open_dataset

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


def with_skipped_named(dataset: PlaceDataset) -> PlaceDataset:
    """Return a dataset, and name the images of it that cannot be read."""
    for broken in dataset.skipped:
        _log.warning("skipped: %s: %s", broken.why, broken.path)
    return dataset

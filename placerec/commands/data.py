# SPDX-License-Identifier: Apache-2.0
"""What the commands share: opening the datasets that they are given, and the progress bar."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import tyro
from tqdm import tqdm

from placerec.datasets import PlaceDataset, open_dataset
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
    return with_skipped_named(open_dataset(source, part))


def with_skipped_named(dataset: PlaceDataset) -> PlaceDataset:
    """Return a dataset, and name the images of it that cannot be read."""
    for broken in dataset.skipped:
        print(f"placerec: skipped: {broken.why}: {broken.path}", file=sys.stderr)
    return dataset


@contextmanager
def progress_bar(title: str, total: int, unit: str = "image") -> Iterator[Progress]:
    """Show a bar while what is inside tells how much is done."""
    # disable=None: no bar where nobody watches, as in a file.
    with tqdm(desc=title, total=total, unit=unit, leave=False, disable=None) as bar:
        yield lambda done, _: bar.update(done - bar.n)

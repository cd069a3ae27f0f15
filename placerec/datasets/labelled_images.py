# SPDX-License-Identifier: Apache-2.0
"""The images of several datasets under one numbering, to learn places from."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.place_dataset import PlaceDataset
from placerec.recognizer import RecognizerError


class LabelledImages:
    """The N images of some datasets, one dataset after the other.

    Attributes:
        places: (N,) int64, a label per image; places of different datasets are different ones.
    """

    places: NDArray[np.int64]

    def __init__(self, datasets: Sequence[PlaceDataset]) -> None:
        """Put one or more datasets together.

        Raises:
            RecognizerError: one has no labels, or two have an image in common.
        """
        self._datasets = tuple(datasets)
        self._starts = np.cumsum([0, *(len(dataset) for dataset in datasets)])
        _refuse_shared_images(self._datasets)
        labels: list[NDArray[np.int64]] = []
        count = 0
        for dataset in self._datasets:
            _, own = np.unique(_labels(dataset), return_inverse=True)
            labels.append(own + count)
            count += int(own.max()) + 1
        self.places = np.concatenate(labels).astype(np.int64)

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int, /) -> NDArray[np.uint8]:
        """Return an image, (H, W, 3) uint8 RGB.

        Raises:
            RecognizerError: it can no longer be read.
        """
        k = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._datasets[k][index - int(self._starts[k])]


def _labels(dataset: PlaceDataset) -> NDArray[np.int64]:
    if dataset.places is None:
        raise RecognizerError(
            f"{dataset.name} tells only which pairs of images show one place; to learn from, each "
            "image needs a label: give clips or a recording with true poses"
        )
    return dataset.places


def _refuse_shared_images(datasets: Sequence[PlaceDataset]) -> None:
    owners: dict[str, str] = {}
    for dataset in datasets:
        for file in {str(path.resolve()) for path in dataset.paths}:
            if file in owners:
                raise RecognizerError(
                    f"{owners[file]} and {dataset.name} have an image in common, and it would be "
                    f"of two places; give each folder once: {file}"
                )
            owners[file] = dataset.name

# SPDX-License-Identifier: Apache-2.0
"""Images, and which pairs of them show the same place."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage, find_fault, read_image
from placerec.errors import RecognizerError
from placerec.files import is_file

BoolMatrix = NDArray[np.bool_]


@dataclass(frozen=True)
class PlaceDataset:
    """N images, by index or one after the other, and the truth about Q x R pairs of them.

    Where a recording is compared with itself, the queries and the references are the same images
    and both matrices are symmetric.

    Attributes:
        name: short name, for people.
        paths: the N image files.
        queries: (Q,) int64, the images that look for their place.
        references: (R,) int64, the images among which they look.
        same_place: (Q, R) bool, whether both show the same place.
        comparable: (Q, R) bool, the pairs that count; others are neither right nor wrong.
        places: (N,) int64, a label per image to train with; None where only pairs are known.
        timestamps_s: (N,) float64, where they are known.
        positions_m: (N, 3) float64, true places of the camera in one world, where they are known.
        quaternions: (N, 4) float64 x y z w of unit length, how it was turned there, likewise.
        skipped: listed images that cannot be read, not among the N.
    """

    name: str
    paths: tuple[Path, ...]
    queries: NDArray[np.int64]
    references: NDArray[np.int64]
    same_place: BoolMatrix
    comparable: BoolMatrix
    places: NDArray[np.int64] | None = None
    timestamps_s: NDArray[np.float64] | None = None
    positions_m: NDArray[np.float64] | None = None
    quaternions: NDArray[np.float64] | None = None
    skipped: tuple[BrokenImage, ...] = ()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int, /) -> NDArray[np.uint8]:
        """Return an image, (H, W, 3) uint8 RGB.

        Raises:
            RecognizerError: it can no longer be read.
        """
        image = read_image(self.paths[index])
        if isinstance(image, BrokenImage):
            raise RecognizerError(f"image {index} cannot be read: {image.why}: {image.path}")
        return image

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        """Yield all N images, decoded one at a time."""
        return (self[index] for index in range(len(self)))

    @property
    def pairs(self) -> BoolMatrix:
        """(Q, R) bool, the pairs that count, each once."""
        if np.array_equal(self.queries, self.references):
            return np.triu(self.comparable, k=1)
        return self.comparable

    def subset(self, keep: NDArray[np.bool_]) -> "PlaceDataset":
        """Return the dataset of the images where (N,) bool is true."""
        renumbered = np.cumsum(keep) - 1
        rows, columns = keep[self.queries], keep[self.references]
        return replace(
            self,
            paths=tuple(path for path, kept in zip(self.paths, keep, strict=True) if kept),
            queries=renumbered[self.queries[rows]],
            references=renumbered[self.references[columns]],
            same_place=self.same_place[np.ix_(rows, columns)],
            comparable=self.comparable[np.ix_(rows, columns)],
            places=None if self.places is None else self.places[keep],
            timestamps_s=None if self.timestamps_s is None else self.timestamps_s[keep],
            positions_m=None if self.positions_m is None else self.positions_m[keep],
            quaternions=None if self.quaternions is None else self.quaternions[keep],
        )


MOST_IMAGES = 20_000
"""Of a dataset: all pairs of them are looked at, and more would not fit into memory."""


def check_images(paths: Sequence[Path], name: str) -> None:
    """Look whether images are there and not too many, before anything is made of all their pairs.

    Raises:
        RecognizerError: there are more than `MOST_IMAGES`, or more than half of them are missing.
    """
    if len(paths) > MOST_IMAGES:
        raise RecognizerError(
            f"{name} has {len(paths)} images, at most {MOST_IMAGES} can be compared with each "
            "other; give a part of it"
        )
    missing = [path for path in paths if not is_file(path)]
    if 2 * len(missing) > len(paths):
        fault = BrokenImage(missing[0], "there is no such file")
        raise RecognizerError(_mostly_broken(len(missing), len(paths), name, fault))


def _mostly_broken(broken: int, count: int, name: str, first: BrokenImage) -> str:
    return (
        f"{broken} of the {count} images of {name} are missing or broken; was it unpacked "
        f"completely? the first: {first.why}: {first.path}"
    )


def keep_readable(dataset: PlaceDataset) -> PlaceDataset:
    """Return the dataset without the images that are missing or broken, which it names.

    Raises:
        RecognizerError: that is more than half of them, or there is no image at all.
    """
    faults = [find_fault(path) for path in dataset.paths]
    broken = tuple(fault for fault in faults if fault is not None)
    if 2 * len(broken) > len(dataset):
        raise RecognizerError(_mostly_broken(len(broken), len(dataset), dataset.name, broken[0]))
    if len(dataset) == 0:
        raise RecognizerError(f"{dataset.name} has no image")
    if not broken:
        return dataset
    return replace(dataset.subset(np.array([fault is None for fault in faults])), skipped=broken)


def describe(dataset: PlaceDataset) -> str:
    """Return how many images, pairs and revisits there are, in one line."""
    revisits = dataset.comparable & dataset.same_place
    found = revisits.any(axis=1)
    return (
        f"{dataset.name}: {len(dataset)} images ({len(dataset.skipped)} skipped), "
        f"{dataset.pairs.sum()} pairs count, {(dataset.pairs & revisits).sum()} of them show one "
        f"place; {found.sum()} of {found.size} queries have a match"
    )

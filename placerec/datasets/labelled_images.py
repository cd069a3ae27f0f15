# SPDX-License-Identifier: Apache-2.0
"""The images of several datasets under one numbering, to learn places from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.place_dataset import PlaceDataset
from placerec.datasets.pose_distance import JUST_BEYOND, SAME_PLACE, pose_distance
from placerec.errors import RecognizerError

_LONGEST_PX = 384
"""Longer sides are shrunk to this, more than any network here looks at: the rest costs time."""
_KEPT = 1024
"""Images kept decoded: those looked at to build sets are soon learned from."""


@dataclass(frozen=True)
class PairTruth:
    """What is known of all pairs of n images, each an (n, n) symmetric bool matrix.

    Attributes:
        same: both show one place; every image does with itself.
        apart: they show different places. What is neither is not known.
        beyond: apart, but seen from just beyond where a place ends.
    """

    same: NDArray[np.bool_]
    apart: NDArray[np.bool_]
    beyond: NDArray[np.bool_]


class LabelledImages:
    """The N images of some datasets, one dataset after the other.

    The datasets come in collections, such as rendered rooms and filmed ones, which are to count the
    same however many images each has.

    Attributes:
        places: (N,) int64, a label per image; places of different datasets are different ones.
            Which images are looked at is drawn by them; what a pair shows is told by `pairs`.
        scenes: (N,) int64, which dataset an image is of.
        collections: (N,) int64, which collection.
    """

    places: NDArray[np.int64]
    scenes: NDArray[np.int64]
    collections: NDArray[np.int64]

    def __init__(self, *collections: Sequence[PlaceDataset]) -> None:
        """Put one or more collections of datasets together.

        Raises:
            RecognizerError: one has no labels, or two have an image in common.
        """
        self._datasets = tuple(dataset for each in collections for dataset in each)
        self._starts = np.cumsum([0, *(len(dataset) for dataset in self._datasets)])
        _refuse_shared_images(self._datasets)
        labels: list[NDArray[np.int64]] = []
        count = 0
        for dataset in self._datasets:
            _, own = np.unique(_labels(dataset), return_inverse=True)
            labels.append(own + count)
            count += int(own.max()) + 1
        self.places = np.concatenate(labels).astype(np.int64)
        self._decoded = lru_cache(maxsize=_KEPT)(self._decode)
        sizes = np.diff(self._starts)
        self.scenes = np.repeat(np.arange(len(self._datasets)), sizes)
        kinds = np.repeat(np.arange(len(collections)), [len(each) for each in collections])
        self.collections = np.repeat(kinds, sizes)

    def __len__(self) -> int:
        return len(self.places)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the N images' files, without their folders."""
        return tuple(path.name for dataset in self._datasets for path in dataset.paths)

    def __getitem__(self, index: int, /) -> NDArray[np.uint8]:
        """Return an image, (H, W, 3) uint8 RGB, at most 384 px wide or high; read-only.

        Raises:
            RecognizerError: it can no longer be read.
        """
        return self._decoded(index)

    def _decode(self, index: int) -> NDArray[np.uint8]:
        k = int(np.searchsorted(self._starts, index, side="right")) - 1
        image = self._datasets[k][index - int(self._starts[k])]
        shrink = _LONGEST_PX / max(image.shape[:2])
        if shrink < 1.0:
            small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
            image = np.asarray(small, np.uint8)
        image.setflags(write=False)
        return image

    def spread(self, at_most: int) -> NDArray[np.int64]:
        """Return the sorted indices of about so many images, as many of each collection, spread."""
        whole = [np.flatnonzero(self.collections == k) for k in np.unique(self.collections)]
        share = max(1, at_most // len(whole))
        return np.concatenate(
            [own[np.linspace(0, len(own) - 1, min(share, len(own))).astype(int)] for own in whole]
        )

    def around(
        self,
        anchors: NDArray[np.int64],
        of_place: int,
        just_beyond: int,
        rng: np.random.Generator,
    ) -> NDArray[np.int64]:
        """Return the sorted indices of the anchors and of images drawn around each.

        Args:
            anchors: (M,) int64.
            of_place: at most so many images of each anchor's place, itself among them.
            just_beyond: at most so many from just beyond it.
            rng: what is drawn from.
        """
        drawn = [anchors]
        for anchor in anchors.tolist():
            k = int(self.scenes[anchor])
            same, beyond = _around(self._datasets[k], anchor - int(self._starts[k]))
            for near, count in ((same, of_place - 1), (beyond, just_beyond)):
                drawn.append(rng.permutation(near)[:count] + self._starts[k])
        return np.unique(np.concatenate(drawn))

    def pairs(self, indices: NDArray[np.int64]) -> PairTruth:
        """Return what is known of all pairs of n images; those of two datasets are apart."""
        scenes = self.scenes[indices]
        same = np.zeros((len(indices), len(indices)), np.bool_)
        apart, beyond = scenes[:, None] != scenes, same.copy()
        for k in np.unique(scenes):
            rows = np.flatnonzero(scenes == k)
            own = _pairs_within(self._datasets[k], indices[rows] - self._starts[k])
            within = np.ix_(rows, rows)
            same[within], apart[within], beyond[within] = own.same, own.apart, own.beyond
        return PairTruth(same, apart, beyond)


def _around(dataset: PlaceDataset, i: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which others of a dataset's images show the place of one, and which just do not."""
    if dataset.positions_m is not None and dataset.quaternions is not None:
        at = dataset.positions_m[i : i + 1], dataset.quaternions[i : i + 1]
        distance = pose_distance(*at, dataset.positions_m, dataset.quaternions)[0]
        is_same = distance < SAME_PLACE
        beyond = np.flatnonzero(~is_same & (distance < JUST_BEYOND))
    else:
        labels = _labels(dataset)
        is_same, beyond = labels == labels[i], np.empty(0, np.int64)
    is_same[i] = False
    return np.flatnonzero(is_same), beyond


def _pairs_within(dataset: PlaceDataset, own: NDArray[np.int64]) -> PairTruth:
    if dataset.positions_m is not None and dataset.quaternions is not None:
        poses = dataset.positions_m[own], dataset.quaternions[own]
        distance = pose_distance(*poses, *poses)
        is_apart = distance >= SAME_PLACE
        return PairTruth(~is_apart, is_apart, is_apart & (distance < JUST_BEYOND))
    labels = _labels(dataset)[own]
    same = labels[:, None] == labels
    is_apart = ~same & ~_may_show_one_place(dataset)[np.ix_(own, own)]
    return PairTruth(same, is_apart, np.zeros_like(same))


def _may_show_one_place(dataset: PlaceDataset) -> NDArray[np.bool_]:
    open_or_same = np.ones((len(dataset), len(dataset)), np.bool_)
    compared = dataset.same_place | ~dataset.comparable
    open_or_same[np.ix_(dataset.queries, dataset.references)] = compared
    open_or_same[np.ix_(dataset.references, dataset.queries)] = compared.T
    return open_or_same


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

# SPDX-License-Identifier: Apache-2.0
"""A second look at the few references most similar to each query, by their local features."""

import hashlib
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset

Image = NDArray[np.uint8]

LOOKED_AT = 10
_LONGER_SIDE_PX = 640
_FEATURES = 500
_FAST_THRESHOLD = 8
_LEAST_SIDE_PX = 39  # below it an image has no room for what a feature describes
_LEAST_MATCHES = 8
_MAX_DISTANCE = 64  # by Hamming
_MAX_OFF_PX = 8.0
_TRIALS = 300
_KEPT = 256
"""Images whose features are kept: the next query has many candidates in common with the last."""


class SecondLook(Protocol):
    """Says how much images have in common, by more than their embeddings."""

    def rerank(self, query: Image, candidates: Sequence[Image]) -> NDArray[np.float64]:
        """Return (C,) scores from 0, nothing, to 1 of images that look like a query.

        All are (H, W, 3) uint8 RGB.
        """
        ...


def look_again(
    similarities: Similarities,
    dataset: PlaceDataset,
    second_look: SecondLook,
    min_similarity: float,
) -> Similarities:
    """Return (Q, R) float32 similarities, -1 to 1, after a second look at ten of each row.

    A full score counts as much as all the way from min_similarity to 1. Where a recording is
    compared with itself, what one image of a pair saw of the other counts for both.

    Raises:
        RecognizerError: an image cannot be read, or the recognizer's own rerank failed.
    """
    scores = np.zeros(similarities.shape)
    possible = np.where(dataset.comparable, similarities, -np.inf)
    for row, query in enumerate(dataset.queries):
        columns = np.argsort(-possible[row], kind="stable")[:LOOKED_AT]
        columns = columns[np.isfinite(possible[row, columns])]
        if len(columns):
            images = [dataset[int(k)] for k in dataset.references[columns]]
            scores[row, columns] = second_look.rerank(dataset[int(query)], images)
    if np.array_equal(dataset.queries, dataset.references):
        scores = np.maximum(scores, scores.T)
    way = 1.0 - min_similarity
    refined: Similarities = ((similarities + way * scores) / (1.0 + way)).astype(np.float32)
    return refined


class _Features(NamedTuple):
    """(N, 2) pixels and (N, 32) uint8 descriptors."""

    pixels: NDArray[np.float64]
    descriptors: NDArray[np.uint8]


_NONE = _Features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8))


class LocalFeatures:
    """Counts the ORB features of two images that one homography takes onto each other.

    The score is the logarithm of one more than that, as a share of the most that can be. The kind
    of features, of motion and of score were chosen on fr1_xyz, the validation floors of ie_tower
    and rendered paths.
    """

    def __init__(self) -> None:
        self._orb = cv2.ORB.create(nfeatures=_FEATURES, fastThreshold=_FAST_THRESHOLD)
        self._kept: dict[bytes, _Features] = {}

    def rerank(self, query: Image, candidates: Sequence[Image]) -> NDArray[np.float64]:
        """Return (C,) scores as a `SecondLook` does."""
        ours = self._features(query)
        counts = [_count_on_homography(ours, self._features(each)) for each in candidates]
        scores = np.log1p(np.minimum(counts, _FEATURES)) / np.log1p(_FEATURES)
        return np.asarray(scores, np.float64)

    def _features(self, image: Image) -> _Features:
        key = hashlib.sha256(image.tobytes()).digest() + str(image.shape).encode()
        found = self._kept.pop(key, None) or self._find(image)
        self._kept[key] = found  # the last to be thrown away
        if len(self._kept) > _KEPT:
            del self._kept[next(iter(self._kept))]
        return found

    def _find(self, image: Image) -> _Features:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        factor = _LONGER_SIDE_PX / max(grey.shape)
        if factor != 1.0:
            way = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
            size = [max(1, round(side * factor)) for side in grey.shape[::-1]]
            grey = cv2.resize(grey, size, interpolation=way)
        if min(grey.shape) < _LEAST_SIDE_PX:
            return _NONE
        keypoints, descriptors = self._orb.detectAndCompute(grey, None)
        if descriptors is None:
            return _NONE
        pixels = np.asarray(cv2.KeyPoint.convert(keypoints), np.float64)
        return _Features(pixels, np.asarray(descriptors, np.uint8))


def _count_on_homography(ours: _Features, theirs: _Features) -> int:
    i, j = _mutual_matches(ours.descriptors, theirs.descriptors).T
    if len(i) < _LEAST_MATCHES:
        return 0
    # OpenCV draws the same samples every time.
    _, inliers = cv2.findHomography(
        ours.pixels[i], theirs.pixels[j], cv2.RANSAC, _MAX_OFF_PX, maxIters=_TRIALS
    )
    return 0 if inliers is None else int(np.count_nonzero(inliers))


def _mutual_matches(ours: NDArray[np.uint8], theirs: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return (M, 2) index pairs of (N, B) and (K, B) uint8 descriptors, each the other's nearest.

    Of equally near ones the first is taken; none is further away by Hamming than the limit.
    """
    if not (len(ours) and len(theirs)):
        return np.zeros((0, 2), np.int64)
    a, b = (np.unpackbits(each, axis=1).astype(np.float32) for each in (ours, theirs))
    # Small whole numbers, which float32 adds up exactly, whatever the order.
    distance = a.sum(axis=1)[:, None] - (2.0 * a - 1.0) @ b.T
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(a))
    is_mutual = distance.argmin(axis=0)[nearest] == rows
    chosen = is_mutual & (distance[rows, nearest] <= _MAX_DISTANCE)
    return np.stack([rows[chosen], nearest[chosen]], axis=1)

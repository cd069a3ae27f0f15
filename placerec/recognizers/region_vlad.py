# SPDX-License-Identifier: Apache-2.0
"""Region-VLAD: the salient regions of a middle convolution, told by words (Khaliq et al. 2019)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from placerec.networks import TRUNKS
from placerec.networks.pooling import find_words
from placerec.recognizers.feature_maps import FittedToMaps, FloatArray, Layer, find_maps, unit_rows
from placerec.recognizers.fitted_file import Fitted

WORDS = 256
_REGIONS = 200
_WORDS_FROM = 300
"""Images, spread evenly, whose regions the words are found among."""
_TOUCHING = np.zeros((3, 3, 3), np.bool_)
_TOUCHING[1] = True
"""Which neighbours of a (channel, row, column) are of its region: the eight of its own channel."""


class RegionVlad(FittedToMaps):
    """Connected regions where a channel is active, the strongest of all channels.

    A region is described by the sum of all channels within it; the image by how its regions differ
    from the words that they are nearest to (VLAD). The cosine compares.

    Attributes:
        min_similarity: of the words; 1 % of the pairs of images of different validation floors of
            ie_tower are as similar with the shipped ones.
    """

    name = "region-vlad"
    layers = (
        Layer(TRUNKS["alexnet"], "conv4", (227, 227)),
        Layer(TRUNKS["squeezenet"], "fire5", (227, 227)),
    )
    """The paper's, and one with as many channels whose weights are small."""
    min_similarity = 0.5

    def __init__(self, path: Path | None = None) -> None:
        super().__init__(path)
        self._words = self._fitted.arrays["words"].astype(np.float32)
        self.weights = f"{self._maps.weights}; {len(self._words)} words of {self._fitted.source}"

    @classmethod
    def fit(cls, images: Sequence[NDArray[np.uint8]], seed: int = 0) -> Fitted:
        """Return words found among the regions of images, by k-means.

        Raises:
            RecognizerError: there are too few images, or no published weights.
        """
        maps = find_maps(cls.layers)
        regions = [salient_regions(each) for each in maps.of_some(images, _WORDS_FROM)]
        words = find_words(np.concatenate(regions), WORDS, seed)
        return Fitted({"words": words.astype(np.float16)}, maps.facts)

    def embed(self, image: NDArray[np.uint8]) -> FloatArray:
        """Return the (K * C,) float32 unit-length embedding of a uint8 RGB image of any size."""
        return residuals(salient_regions(self._maps(image)), self._words)


def salient_regions(maps: FloatArray, count: int = _REGIONS) -> FloatArray:
    """Return (N, C) unit vectors: of (C, h, w) maps, the sums of all channels over each region.

    A region is connected, in one channel, and above zero; those of the highest mean are salient.
    There are fewer than so many where there are no more, and none where nothing is above zero.
    """
    labels, found = ndimage.label(maps > 0.0, structure=_TOUCHING)
    flat = labels.ravel()
    sizes = np.bincount(flat, minlength=found + 1)[1:]
    means = np.bincount(flat, weights=maps.ravel(), minlength=found + 1)[1:] / sizes
    salient = np.argsort(-means, kind="stable")[:count]
    rank = np.full(found + 1, len(salient))
    rank[salient + 1] = np.arange(len(salient))
    channel_px = maps.shape[1] * maps.shape[2]
    members = np.flatnonzero(rank[flat] < len(salient))
    masks = np.zeros((len(salient), channel_px), np.float32)
    masks[rank[flat[members]], members % channel_px] = 1.0
    return unit_rows(masks @ maps.reshape(len(maps), channel_px).T)


def residuals(regions: FloatArray, words: FloatArray) -> FloatArray:
    """Return the (K * C,) unit vector of (N, C) regions: the sums of differences to (K, C) words.

    Each word's sum is of unit length first. Without any region, all words are missed alike.
    """
    # Of unit vectors the nearest word is not just that of the largest product: words are shorter.
    nearest = (regions @ words.T - 0.5 * np.square(words).sum(axis=1)).argmax(axis=1)
    shares = np.zeros((len(words), len(regions)), np.float32)
    shares[nearest, np.arange(len(regions))] = 1.0
    sums = shares @ regions - shares.sum(axis=1, keepdims=True) * words
    rows = unit_rows(sums if len(regions) else -words)
    return np.asarray(rows.ravel() / np.linalg.norm(rows), np.float32)

# SPDX-License-Identifier: Apache-2.0
"""Region-VLAD: the salient regions of a middle convolution, told by words (Khaliq et al. 2019)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from placerec.certificate import Certificate, certificate_beside
from placerec.networks import TRUNKS
from placerec.networks.pooling import find_words
from placerec.recognizers.feature_maps import Layer, facts_of, find_fitted_maps, find_maps
from placerec.recognizers.fitted_file import Fitted, read_fitted, shipped

NAME = "region-vlad"
SHIPPED = shipped(NAME)
LAYERS = (
    Layer(TRUNKS["alexnet"], "conv4", (227, 227)),
    Layer(TRUNKS["squeezenet"], "fire5", (227, 227)),
)
"""The paper's, and one with as many channels whose weights are small."""
WORDS = 256
REGIONS = 200
TINY = 1e-12
WORDS_FROM = 300
"""Images, spread evenly, whose regions the words are found among."""
TOUCHING = np.zeros((3, 3, 3), np.bool_)
TOUCHING[1] = True
"""Which neighbours of a (channel, row, column) are of its region: the eight of its own channel."""

FloatArray = NDArray[np.float32]


class RegionVlad:
    """Connected regions where a channel is active, the strongest of all channels.

    A region is described by the sum of all channels within it; the image by how its regions differ
    from the words that they are nearest to (VLAD). The cosine compares.

    Attributes:
        min_similarity: of the words; 1 % of the pairs of images of different validation floors of
            ie_tower are as similar with the shipped ones.
    """

    min_similarity: float = 0.5

    def __init__(self, path: Path = SHIPPED) -> None:
        """Read words, by default the shipped ones, and the published weights.

        Raises:
            RecognizerError: one of them is missing, or they do not fit.
        """
        fitted = read_fitted(path, NAME)
        self._maps = find_fitted_maps(NAME, fitted, LAYERS)
        self._words = fitted.arrays["words"].astype(np.float32)
        self._path = path
        self.min_similarity, self.trained_on = fitted.min_similarity, fitted.trained_on
        self.fingerprint = fitted.fingerprint
        self.weights = f"{self._maps.weights}; {len(self._words)} words of {fitted.source}"

    @property
    def certificate(self) -> Certificate | None:
        """What min_similarity was calibrated on, where a certificate lies beside the words."""
        return certificate_beside(self._path)

    @classmethod
    def fit(cls, images: Sequence[NDArray[np.uint8]], seed: int = 0) -> Fitted:
        """Return words found among the regions of images, by k-means.

        Raises:
            RecognizerError: there are too few images, or no published weights.
        """
        maps = find_maps(LAYERS)
        chosen = np.linspace(0, len(images) - 1, min(len(images), WORDS_FROM)).astype(int)
        regions = np.concatenate([salient_regions(maps(images[int(i)])) for i in chosen])
        words = find_words(regions, WORDS, seed)
        return Fitted({"words": words.astype(np.float16)}, facts_of(maps))

    def embed(self, image: NDArray[np.uint8]) -> FloatArray:
        """Return the (K * C,) float32 unit-length embedding of a uint8 RGB image of any size."""
        return residuals(salient_regions(self._maps(image)), self._words)


def salient_regions(maps: FloatArray, count: int = REGIONS) -> FloatArray:
    """Return (N, C) unit vectors: of (C, h, w) maps, the sums of all channels over each region.

    A region is connected, in one channel, and above zero; those of the highest mean are salient.
    There are fewer than so many where there are no more, and none where nothing is above zero.
    """
    labels, found = ndimage.label(maps > 0.0, structure=TOUCHING)
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
    sums: FloatArray = masks @ maps.reshape(len(maps), channel_px).T
    return _unit(sums)


def residuals(regions: FloatArray, words: FloatArray) -> FloatArray:
    """Return the (K * C,) unit vector of (N, C) regions: the sums of differences to (K, C) words.

    Each word's sum is of unit length first. Without any region, all words are missed alike.
    """
    # Of unit vectors the nearest word is not just that of the largest product: words are shorter.
    nearest = (regions @ words.T - 0.5 * np.square(words).sum(axis=1)).argmax(axis=1)
    shares = np.zeros((len(words), len(regions)), np.float32)
    shares[nearest, np.arange(len(regions))] = 1.0
    sums = shares @ regions - shares.sum(axis=1, keepdims=True) * words
    rows = _unit(sums if len(regions) else -words)
    return np.asarray(rows.ravel() / np.linalg.norm(rows), np.float32)


def _unit(rows: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, TINY), np.float32)

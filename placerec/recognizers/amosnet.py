# SPDX-License-Identifier: Apache-2.0
"""AMOSNet and HybridNet: a network trained to name places, pooled in ever larger cells.

Chen, Jacobson, Sünderhauf, Upcroft, Liu, Shen, Reid, Milford: Deep Learning Features at Scale for
Visual Place Recognition, ICRA 2017. Both are CaffeNet up to its fifth convolution.
"""

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import Embeddings, Similarities
from placerec.networks import TRUNKS
from placerec.networks.alexnet import CAFFENET
from placerec.recognizers.feature_maps import TINY, FloatArray, Layer, find_maps

_LEVELS = (4, 3, 2, 1)
"""Cells along each side of the image, from fine to coarse."""
_STAND_INS = (
    Layer(TRUNKS["alexnet"], "conv5", (227, 227)),
    Layer(TRUNKS["squeezenet"], "fire9", (227, 227)),
)
"""Trained on ImageNet, with maps of 13 x 13 as well."""
_BLOCK = 16
"""References at a time: what is subtracted stays in the processor's cache."""


class AmosNet:
    """The spatial pyramid of conv5, compared by the sum of absolute differences (L1).

    Runs on the authors' weights, `AmosNet.caffemodel`, where these are on the machine, and on a
    trunk that was trained on ImageNet otherwise; `weights` says which.

    Attributes:
        min_similarity: 1 % of the pairs of images of different validation floors of ie_tower are as
            similar, with SqueezeNet in place of the authors' weights.
    """

    FILE = "AmosNet"
    min_similarity: float = 0.62
    looks_back = 0

    def __init__(self) -> None:
        """Read the weights.

        Raises:
            RecognizerError: there are none, or they cannot be used.
        """
        own = Layer(CAFFENET, "conv5", (227, 227), self.FILE)
        self._maps = find_maps([own, *_STAND_INS])
        is_own = self._maps.title == own.title
        self.weights = self._maps.weights + ("" if is_own else f" in place of {self.FILE}'s")
        self.fingerprint = self._maps.fingerprint

    def embed(self, image: NDArray[np.uint8]) -> FloatArray:
        """Return the (D,) float32 pyramid of an image, none negative and 1 in all."""
        values = spatial_pyramid(np.maximum(self._maps(image), 0.0)) + TINY
        return np.asarray(values / values.sum(dtype=np.float64), np.float32)

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return (Q, R) float32: 1 less half of the sum of absolute differences, 0 to 1."""
        similarities = np.empty((len(queries), len(references)), np.float32)
        for start in range(0, len(references), _BLOCK):
            block = references[start : start + _BLOCK]
            for row, query in zip(similarities, queries, strict=True):
                row[start : start + _BLOCK] = 1.0 - np.abs(block - query).sum(axis=1) / 2.0
        return similarities


class HybridNet(AmosNet):
    """As AMOSNet, its weights trained from CaffeNet's instead of from scratch."""

    FILE = "HybridNet"


def spatial_pyramid(maps: FloatArray) -> FloatArray:
    """Return the (C * 30,) maxima of (C, h, w) maps in 4 x 4, 3 x 3, 2 x 2 cells and in all.

    Cells are as large as they must be to cover the maps, and may overlap by a row or column.
    """
    height, width = maps.shape[1:]
    pooled = [
        maps[:, rows, columns].max(axis=(1, 2))
        for count in _LEVELS
        for rows in _cells(height, count)
        for columns in _cells(width, count)
    ]
    return np.concatenate(pooled)


def _cells(size: int, count: int) -> list[slice]:
    return [slice(i * size // count, -(-(i + 1) * size // count)) for i in range(count)]

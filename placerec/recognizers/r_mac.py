# SPDX-License-Identifier: Apache-2.0
"""R-MAC: what is strongest in each region of an image, the regions matched with each other.

Tolias, Sicre, Jégou: Particular object retrieval with integral max-pooling of CNN activations,
ICLR 2016. As in the multi-constraint paper the regions are not summed up but matched.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import Embeddings, Similarities
from placerec.networks import TRUNKS
from placerec.recognizers.feature_maps import FittedToMaps, FloatArray, Layer, find_maps, unit_rows
from placerec.recognizers.fitted_file import Fitted

_SCALES = 3
_OVERLAP = 0.4
"""Of neighbouring regions of the largest scale, as nearly as the shape of the maps allows."""
_MOST_ALONG = 6
_TIE = 1e-5
"""Regions whose cosines differ by less are equally good matches."""
EVENNESS = 0.1
"""Share of the mean variance that is added to each before it is whitened."""


class RMac(FittedToMaps):
    """Regions of a network's last maps, whitened; compared by the regions that match mutually.

    Attributes:
        min_similarity: 1 % of the pairs of images of different validation floors of ie_tower are as
            similar.
    """

    name = "r-mac"
    layers = (
        Layer(TRUNKS["vgg16"], "conv5_2", (224, 224)),
        Layer(TRUNKS["mobilenet_v2"], "block16", (320, 240)),
    )
    """The paper's, and one whose weights are small; its image size, and EVENNESS, have the highest
    average precision of those tried on the validation floors of ie_tower, 0.47 (192x144: 0.43)."""
    min_similarity = 0.055
    looks_back = 0

    def __init__(self, path: Path | None = None) -> None:
        super().__init__(path)
        self._mean, self._whitening = (
            self._fitted.arrays[name].astype(np.float32) for name in ("mean", "whitening")
        )
        self.weights = f"{self._maps.weights}; whitened on {self._fitted.source}"

    @classmethod
    def fit(cls, images: Iterable[NDArray[np.uint8]], seed: int = 0) -> Fitted:
        """Return the whitening of the regions of images: their principal components."""
        maps = find_maps(cls.layers)
        regions = np.concatenate([pooled_regions(maps(image)) for image in images])
        mean, whitening = principal_components(regions)
        learned = {"mean": mean.astype(np.float16), "whitening": whitening.astype(np.float16)}
        return Fitted(learned, maps.facts)

    def embed(self, image: NDArray[np.uint8]) -> FloatArray:
        """Return the (N, C) float32 unit-length rows of an image's N regions."""
        regions = pooled_regions(self._maps(image))
        return unit_rows((regions - self._mean) @ self._whitening.T)

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return the (Q, R) float32 shares of regions that match mutually, each by its cosine."""
        return np.array([_matched(query, references) for query in queries], np.float32)


def regions_of(height: int, width: int) -> list[tuple[int, int, int]]:
    """Return top, left and side of square regions of maps, of three sizes.

    At scale l there are l of them along the shorter side and l + m - 1 along the longer, twice the
    shorter divided by l + 1 wide; m is such that those of the first overlap by 0.4.
    """
    short, long = min(height, width), max(height, width)
    # Among m regions of side `short` along `long`, neighbours are (long - short) / (m - 1) apart.
    steps = {m: (long - short) / (m - 1) for m in range(2, _MOST_ALONG + 2)}
    m = 1 if long == short else min(steps, key=lambda m: abs(1.0 - steps[m] / short - _OVERLAP))
    found: list[tuple[int, int, int]] = []
    for scale in range(1, _SCALES + 1):
        side = max(1, 2 * short // (scale + 1))
        few = np.linspace(0, short - side, scale).astype(int)
        many = np.linspace(0, long - side, scale + m - 1).astype(int)
        rows, columns = (few, many) if height <= width else (many, few)
        found += [(int(row), int(column), side) for row in rows for column in columns]
    return found


def pooled_regions(maps: FloatArray) -> FloatArray:
    """Return the (N, C) unit-length maxima of the regions of (C, h, w) maps."""
    squares = regions_of(*maps.shape[1:])
    pooled = [maps[:, y : y + side, x : x + side].max(axis=(1, 2)) for y, x, side in squares]
    return unit_rows(np.stack(pooled))


def principal_components(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the (C,) mean of (M, C) rows, and the (C, C) whitening by principal components."""
    mean = rows.mean(axis=0, dtype=np.float64)
    centred = rows - mean
    variances, directions = np.linalg.eigh(centred.T @ centred / len(rows))
    variances = np.maximum(variances, 0.0) + EVENNESS * max(float(variances.mean()), 1e-12)
    order = np.argsort(-variances)
    whitening = (directions / np.sqrt(variances)).T[order]
    return mean.astype(np.float32), whitening.astype(np.float32)


def _matched(query: FloatArray, references: Embeddings) -> FloatArray:
    """Return the (R,) similarities of (N, C) regions to (R, N, C) ones."""
    cosines = references @ query.T
    best_of_query = cosines.max(axis=1)
    best_of_reference = cosines.max(axis=2, keepdims=True)
    mutual = cosines >= np.maximum(best_of_query[:, None], best_of_reference) - _TIE
    return np.asarray(np.where(mutual.any(axis=1), best_of_query, 0.0).mean(axis=1), np.float32)

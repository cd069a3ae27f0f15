# SPDX-License-Identifier: Apache-2.0
"""The honest floor: one layer of a network that was trained on ImageNet, and on nothing else."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.networks import TRUNKS
from placerec.recognizers.feature_maps import FittedToMaps, Layer, find_maps
from placerec.recognizers.fitted_file import Fitted

LAYER = Layer(TRUNKS["mobilenet_v2"], "block16", (192, 144))


class UntrainedLayer(FittedToMaps):
    """The flattened maps of a layer, less their mean over other images, on the unit sphere.

    Which layer matters more than anything else, so it was chosen in this method's favour: of all
    blocks of MobileNetV2 and SqueezeNet, at two image sizes each, this one has the highest average
    precision on the validation floors of ie_tower: 0.40, the next best 0.39 at the smaller size and
    0.33 one block earlier, SqueezeNet's best 0.25.

    Attributes:
        min_similarity: 1 % of the pairs of images of different validation floors are as similar.
    """

    name = "untrained"
    layers = (LAYER,)
    min_similarity = 0.28

    def __init__(self, path: Path | None = None) -> None:
        super().__init__(path)
        self._mean = self._fitted.arrays["mean"].astype(np.float32)
        self.weights = f"{self._maps.weights}; mean of {self._fitted.source}"

    @classmethod
    def fit(cls, images: Iterable[NDArray[np.uint8]], seed: int = 0) -> Fitted:
        """Return the layer's mean over images; nothing is drawn."""
        maps = find_maps(cls.layers)
        total, count = np.zeros((), np.float64), 0
        for image in images:
            total = total + maps(image)
            count += 1
        return Fitted({"mean": (total / max(1, count)).astype(np.float16)}, maps.facts)

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a uint8 RGB image of any size."""
        values = (self._maps(image) - self._mean).ravel()
        return np.asarray(values / np.linalg.norm(values), np.float32)

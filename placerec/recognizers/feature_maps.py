# SPDX-License-Identifier: Apache-2.0
"""The maps of one layer of a published network."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from placerec.errors import RecognizerError
from placerec.networks import PlaceNetwork, Trunk
from placerec.networks.preprocessing import one_thread
from placerec.networks.pretrained import (
    FOLDER_VARIABLE,
    SUFFIXES,
    find_pretrained,
    load_pretrained,
    weights_folders,
)
from placerec.recognizers.fitted_file import Fitted

FloatArray = NDArray[np.float32]

TINY = 1e-12
_LAYER, _WEIGHTS = "layer", "weights"


@dataclass(frozen=True)
class Layer:
    """A layer of a trunk that looks at images of a size.

    Attributes:
        trunk, block: which.
        size_px: width and height that images are resized to.
        file: how the name of its file of weights begins; "" is the trunk's name.
    """

    trunk: Trunk
    block: str
    size_px: tuple[int, int]
    file: str = ""

    @property
    def title(self) -> str:
        """What it is called where it is named."""
        width_px, height_px = self.size_px
        return f"{self.trunk.name} {self.block} at {width_px}x{height_px} px"

    def find(self) -> Path | None:
        """Return its file of weights, None where it is not on this machine."""
        return find_pretrained(self.file or self.trunk.name)


class FeatureMaps:
    """Images in, maps out; on the CPU, and safe to use by threads.

    Attributes:
        title: the layer, without its weights.
        weights: the layer and its weights, in a line.
        fingerprint: changes whenever the maps do.
    """

    def __init__(self, layer: Layer, path: Path) -> None:
        """Load a layer with a file of weights.

        Raises:
            RecognizerError: the weights cannot be used.
        """
        network = PlaceNetwork(layer.trunk, 1, block=layer.block, size_px=layer.size_px)
        load_pretrained(network, path)
        self._network = network.eval()
        self.title = layer.title
        self.weights = f"{layer.title}, published weights {path.name}"
        self.fingerprint = _fingerprint(layer.title, network)

    def __call__(self, image: NDArray[np.uint8]) -> FloatArray:
        """Return the (C, h, w) float32 maps of a uint8 RGB image of any size.

        Raises:
            RecognizerError: it is no such image.
        """
        with one_thread(), torch.inference_mode():
            maps = self._network.features(self._network.prepare([image]))
        return np.ascontiguousarray(maps[0].numpy(), dtype=np.float32)

    def of_some(self, images: Sequence[NDArray[np.uint8]], at_most: int) -> Iterator[FloatArray]:
        """Yield the maps of some images, spread evenly over all."""
        for i in np.linspace(0, len(images) - 1, min(len(images), at_most)).astype(int):
            yield self(images[int(i)])


def find_maps(layers: Sequence[Layer]) -> FeatureMaps:
    """Return the maps of the first layer whose weights are on this machine.

    Raises:
        RecognizerError: there are none of any, or those found cannot be used.
    """
    for layer in layers:
        if path := layer.find():
            return FeatureMaps(layer, path)
    files = " or ".join(dict.fromkeys(layer.file or layer.trunk.name for layer in layers))
    raise RecognizerError(
        f"there is no file of published weights whose name begins with {files} ("
        f"{', '.join(sorted(SUFFIXES))}); put it into the folder that the environment variable "
        f"{FOLDER_VARIABLE} names, or into {weights_folders()[-1]}"
    )


def find_fitted_maps(name: str, fitted: Fitted, layers: Sequence[Layer]) -> FeatureMaps:
    """Return the maps of the layer, of several, that a baseline was fitted with.

    Raises:
        RecognizerError: its weights are missing, or are others than it was fitted with.
    """
    title = fitted.facts.get(_LAYER)
    layers = [layer for layer in layers if layer.title == title]
    maps = find_maps(layers) if layers else None
    if maps is None or maps.fingerprint != fitted.facts.get(_WEIGHTS):
        raise RecognizerError(
            f"{name} has seen images with other weights than are here; do it again: "
            f"placerec fit {name} FOLDER --out FILE"
        )
    return maps


def facts_of(maps: FeatureMaps) -> dict[str, str]:
    """Return what `find_fitted_maps` knows a layer and its weights by."""
    return {_LAYER: maps.title, _WEIGHTS: maps.fingerprint}


def unit_rows(rows: NDArray[np.floating[Any]]) -> FloatArray:
    """Return (N, C) rows brought to unit length; rows of zeros stay what they are."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, TINY), np.float32)


def _fingerprint(title: str, network: PlaceNetwork) -> str:
    digest = hashlib.sha256(repr((title, network.preprocessing)).encode())
    for name, value in sorted(network.features.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.contiguous().numpy().tobytes())
    return f"sha256:{digest.hexdigest()}"

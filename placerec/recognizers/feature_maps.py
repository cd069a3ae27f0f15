# SPDX-License-Identifier: Apache-2.0
"""The maps of one layer of a published network."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from placerec.errors import RecognizerError
from placerec.networks import PlaceNetwork, Trunk
from placerec.networks.device import on_another
from placerec.networks.pretrained import (
    FOLDER_VARIABLE,
    SUFFIXES,
    find_pretrained,
    load_pretrained,
    weights_folders,
)
from placerec.networks.torch_device import on_device_asked_for, one_thread
from placerec.recognizers.fitted_file import FittedRecognizer

FloatArray = NDArray[np.float32]

TINY = 1e-12


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


class FeatureMaps:
    """Images in, maps out; safe to use by threads.

    They are computed on the CPU, unless $LOOPCLOSE_DEVICE names something else.

    Attributes:
        title: the layer, without its weights.
        weights: the layer and its weights, in a line.
        fingerprint: changes whenever the maps do.
        facts: what a file that goes with them knows the layer and its weights by.
    """

    def __init__(self, layer: Layer, path: Path) -> None:
        """Load a layer with a file of weights.

        Raises:
            RecognizerError: the weights cannot be used, or there is no such device.
        """
        network = PlaceNetwork(layer.trunk, 1, block=layer.block, size_px=layer.size_px)
        load_pretrained(network, path)
        self.title = layer.title
        self.weights = f"{layer.title}, published weights {path.name}{on_another()}"
        digest = hashlib.sha256(repr((layer.title, network.preprocessing)).encode())
        for name, value in sorted(network.features.state_dict().items()):
            digest.update(name.encode())
            digest.update(value.contiguous().numpy().tobytes())
        self.fingerprint = f"sha256:{digest.hexdigest()}"
        self.facts = {"layer": self.title, "weights": self.fingerprint}
        self._network, self._device = on_device_asked_for(network.eval())

    def __call__(self, image: NDArray[np.uint8]) -> FloatArray:
        """Return the (C, h, w) float32 maps of a uint8 RGB image of any size.

        Raises:
            RecognizerError: it is no such image.
        """
        with one_thread(), torch.inference_mode():
            maps = self._network.features(self._network.prepare([image]).to(self._device))
        return np.ascontiguousarray(maps[0].cpu().numpy(), dtype=np.float32)

    def of_some(self, images: Sequence[NDArray[np.uint8]], at_most: int) -> Iterator[FloatArray]:
        """Yield the maps of some images, spread evenly over all."""
        for i in np.linspace(0, len(images) - 1, min(len(images), at_most)).astype(int):
            yield self(images[int(i)])


def find_maps(layers: Sequence[Layer]) -> FeatureMaps:
    """Return the maps of the first layer whose weights are on this machine.

    Raises:
        RecognizerError: there are none of any, or those found cannot be used.
    """
    names = [layer.file or layer.trunk.name for layer in layers]
    for layer, name in zip(layers, names, strict=True):
        if path := find_pretrained(name):
            return FeatureMaps(layer, path)
    own = "".join(f", or into {folder}" for folder in weights_folders()[-1:])
    raise RecognizerError(
        "there is no file of published weights whose name begins with "
        f"{' or '.join(dict.fromkeys(names))} ("
        f"{', '.join(sorted(SUFFIXES))}); put it into the folder that the environment variable "
        f"{FOLDER_VARIABLE} names{own}"
    )


class FittedToMaps(FittedRecognizer):
    """What recognizers have in common whose file goes with a published layer's maps.

    Attributes:
        layers: of these the file goes with one; the best first.
    """

    layers: ClassVar[tuple[Layer, ...]]

    def __init__(self, path: Path | None = None) -> None:
        super().__init__(path)
        facts = self._fitted.facts
        layers = [layer for layer in self.layers if layer.title == facts.get("layer")]
        maps = find_maps(layers) if layers else None
        if maps is None or not maps.facts.items() <= facts.items():
            raise RecognizerError(
                f"{self.name} has seen images with other weights than are here; do it again: "
                f"placerec fit {self.name} FOLDER --out FILE"
            )
        self._maps = maps


def unit_rows(rows: NDArray[np.floating[Any]]) -> FloatArray:
    """Return (N, C) rows brought to unit length; rows of zeros stay what they are."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, TINY), np.float32)

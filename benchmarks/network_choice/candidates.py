# SPDX-License-Identifier: Apache-2.0
"""The networks to choose from, as they are before any training."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from placerec.networks import TRUNKS, PlaceNetwork, Trunk
from placerec.networks.pretrained import load_pretrained
from placerec.networks.whitening import merge, whiten

Image = NDArray[np.uint8]

PUBLISHED_WEIGHTS = {
    "mobilenet_v2": Path("mobilenet_v2/mobilenet_v2.npz"),
    "squeezenet": Path("squeezenet_v1.0/squeezenet_v1.0.npz"),
}
LAYERS = {
    "mobilenet_v2": ("block6", "block9", "block12", "block13"),
    "squeezenet": ("fire3", "fire5", "fire7", "fire9"),
}
GRID = (3, 4)
CHANNELS = (None, 64, 96)
SIZES_PX = ((224, 168), (320, 240))
DIMENSIONS = (512, 1000)
IMAGES_PER_PASS = 32
CHANNELS_FROM = 250
"""Images that principal directions of the channels are taken from."""


@dataclass(frozen=True)
class Candidate:
    """A trunk, cut after a layer, with one statistic of its maps.

    Attributes:
        trunk, layer: where the maps come from.
        pooling: "covariance", or "cells", the means in a grid.
        channels: how many the maps are reduced to before their covariance; None: not reduced.
        size_px: (width, height) of the input.
        dimension: values in an embedding.
    """

    trunk: str
    layer: str
    pooling: str
    channels: int | None
    size_px: tuple[int, int]
    dimension: int

    def __str__(self) -> str:
        """Return what a table calls it."""
        reduced = f" of {self.channels} channels" if self.channels else ""
        width, height = self.size_px
        where = f"{self.trunk} {self.layer} at {width}x{height}"
        return f"{where}, {self.pooling}{reduced}, {self.dimension} values"


def candidates() -> Iterator[Candidate]:
    """Yield all that are compared."""
    for size_px, (trunk, layers) in product(SIZES_PX, LAYERS.items()):
        for layer, dimension in product(layers, DIMENSIONS):
            yield Candidate(trunk, layer, "cells", None, size_px, dimension)
            for channels in CHANNELS:
                yield Candidate(trunk, layer, "covariance", channels, size_px, dimension)


@torch.no_grad()
def build(candidate: Candidate, published: Path, fitted_on: Sequence[Image]) -> PlaceNetwork:
    """Return a candidate's network with its trunk as published and its last layer from whitening.

    Args:
        candidate: what to build.
        published: folder of the published weights.
        fitted_on: images that channels are reduced by, and that are whitened.

    Raises:
        RecognizerError: there are no such weights, or they do not fit.
    """
    trunk = TRUNKS[candidate.trunk]
    network = _network(trunk, candidate)
    load_pretrained(network, published / PUBLISHED_WEIGHTS[candidate.trunk])
    network.eval()
    if candidate.channels:
        every = len(fitted_on) // CHANNELS_FROM or 1
        reduce = _reduction(network, fitted_on[::every], candidate.channels)
        reduced = nn.Sequential(network.features, reduce)
        own = Trunk(f"{trunk.name}-reduced", lambda: reduced, trunk.preprocessing)
        network = _network(own, candidate, block=None).eval()
    values = _through(network, lambda x: network.flatten(network.features(x)), fitted_on)
    whiten(network, values)
    merge(network)
    return network


@torch.no_grad()
def embed(network: PlaceNetwork, images: Iterable[Image]) -> NDArray[np.float32]:
    """Return (N, D) embeddings of N images."""
    embeddings: NDArray[np.float32] = _through(network, network, images).numpy()
    return embeddings


def megabytes(network: PlaceNetwork) -> float:
    """Return the size of its weights in half precision."""
    numbers: int = sum(value.numel() for value in network.state_dict().values())
    return 2e-6 * numbers


def _network(trunk: Trunk, candidate: Candidate, block: str | None = "as named") -> PlaceNetwork:
    return PlaceNetwork(
        trunk,
        candidate.dimension,
        block=candidate.layer if block else None,
        grid=GRID if candidate.pooling == "cells" else None,
        covariance=candidate.pooling == "covariance",
        size_px=candidate.size_px,
    )


def _reduction(network: PlaceNetwork, images: Sequence[Image], channels: int) -> nn.Conv2d:
    """Return the convolution that keeps the directions in which maps vary most within an image."""

    def covariance(inputs: Tensor) -> Tensor:
        values: Tensor = network.features(inputs).flatten(start_dim=2)
        values = values - values.mean(dim=2, keepdim=True)
        return values @ values.transpose(1, 2) / values.shape[2]

    mean = _through(network, covariance, images).double().mean(dim=0)
    variances, directions = torch.linalg.eigh(mean)
    kept = slice(-min(channels, len(mean)), None)
    scale = variances[kept].mean().rsqrt()
    layer = nn.Conv2d(len(mean), len(variances[kept]), kernel_size=1, bias=False)
    layer.weight.copy_((scale * directions[:, kept].T.flip(0))[..., None, None])
    return layer


def _through(
    network: PlaceNetwork, step: Callable[[Tensor], Tensor], images: Iterable[Image]
) -> Tensor:
    rest = iter(images)
    parts = iter(lambda: list(islice(rest, IMAGES_PER_PASS)), [])
    return torch.cat([step(network.prepare(part)) for part in parts])

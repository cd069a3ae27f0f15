# SPDX-License-Identifier: Apache-2.0
"""The part of a network that is not trained, and what it makes of the training images."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from placerec.errors import RecognizerError
from placerec.files import Progress
from placerec.networks import PlaceNetwork
from placerec.training.images import Augmentation, PlaceImages

IMAGES_PER_PASS = 32


class EarlyLayers:
    """Turns images into what the trained layers take: themselves, or the frozen layers' maps.

    Attributes:
        trained: the trunk's layers behind the frozen ones.
    """

    trained: nn.Module

    def __init__(
        self,
        network: PlaceNetwork,
        images: PlaceImages,
        frozen_block: str | None,
        device: torch.device,
    ) -> None:
        """Freeze a network's trunk up to the end of a block.

        Raises:
            RecognizerError: there is no such block in the network.
        """
        self._network, self._images, self._device = network, images, device
        self._frozen: nn.Module | None = None
        self._maps: Tensor | None = None
        self.trained = network.features
        network.requires_grad_(True)  # what an earlier training froze may be trained now
        if frozen_block is not None:
            self._frozen, self.trained = _split(network, frozen_block)
            self._frozen.requires_grad_(False)

    def keep_maps(self, count: int, progress: Progress | None = None) -> None:
        """Work out the frozen layers' maps of all n images, to be looked up from now on."""
        if self._frozen is None:
            return
        maps: list[Tensor] = []
        # Always in the same portions: the last bits of a map depend on what it is computed with.
        for start in range(0, count, IMAGES_PER_PASS):
            indices = np.arange(start, min(start + IMAGES_PER_PASS, count))
            maps.append(self._through([self._images[int(i)] for i in indices]).cpu())
            if progress:
                progress(int(indices[-1]) + 1, count)
        self._maps = torch.cat(maps)

    def plain(self, indices: NDArray[np.int64]) -> Tensor:
        """Return the trained layers' input of N images as they are."""
        if self._maps is not None:
            return self._maps[torch.from_numpy(indices)].to(self._device)
        return self._through([self._images[int(i)] for i in indices])

    def varied(
        self, indices: NDArray[np.int64], augmentation: Augmentation, seeds: Sequence[list[int]]
    ) -> Tensor:
        """Return the trained layers' input of N images, each changed at random by its own seed."""
        draws = (np.random.default_rng(seed) for seed in seeds)
        views = [
            augmentation(self._images[int(i)], rng) for i, rng in zip(indices, draws, strict=True)
        ]
        return self._through(views)

    def _through(self, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        inputs = self._network.prepare(images).to(self._device)
        if self._frozen is None:
            return inputs
        with torch.no_grad():
            self._frozen.eval()
            maps: Tensor = self._frozen(inputs)
        return maps


def _split(network: PlaceNetwork, block: str) -> tuple[nn.Module, nn.Module]:
    count = network.trunk.layer_count(block)
    layers = network.features
    if not isinstance(layers, nn.Sequential) or count > len(layers):
        raise RecognizerError(
            f"frozen_block = {block!r}: the network is cut before it, after {network.block!r}"
        )
    return layers[:count], layers[count:]

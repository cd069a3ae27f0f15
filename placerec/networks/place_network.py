# SPDX-License-Identifier: Apache-2.0
"""A trunk, one fully connected layer of adjustable size, and the unit sphere."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from placerec.errors import RecognizerError
from placerec.networks.pooling import Covariance, Vlad, WhitenedLinear
from placerec.networks.trunk import Trunk

_MOST_VALUES = 100_000
_MOST_WORDS = 10_000
_MOST_CELLS_A_SIDE = 256
_MOST_PX_A_SIDE = 4096


class PlaceNetwork(nn.Module):
    """What the paper makes of a classification network (section 2.1).

    Attributes:
        trunk, block, grid, covariance, words: what it was made with.
        preprocessing: how an image becomes its input.
        features: the trunk's layers up to the block, called as the trunk calls them.
        pool: from their maps to the values that the fully connected layer takes.
        fully_connected: from these to the embedding.
    """

    def __init__(
        self,
        trunk: Trunk,
        dimension: int,
        *,
        block: str | None = None,
        grid: tuple[int, int] | None = None,
        covariance: bool = False,
        words: int | None = None,
        size_px: tuple[int, int] | None = None,
        seed: int = 0,
    ) -> None:
        """Make a network with a trunk as it is built and a random fully connected layer.

        Args:
            trunk: a known one or one's own.
            dimension: values in an embedding.
            block: the trunk's last block to keep; default: all of it.
            grid: (rows, columns) to average the maps in; default: keep them whole.
            covariance: describe the maps by how their channels vary together (`Covariance`), not
                by their values, as the paper does.
            words: describe the maps by how they differ from so many words (`Vlad`).
            size_px: (width, height) of its input; default: the trunk's.
            seed: what the random weights come from.

        Raises:
            RecognizerError: there is no such block, the dimension is not positive, the input is
                too small, the trunk does not make maps, or these are to be described in two ways.
        """
        super().__init__()
        _check(dimension, grid, words, covariance, size_px)
        self.trunk, self.block, self.grid = trunk, block, grid
        self.covariance, self.words = covariance, words
        self.preprocessing = trunk.preprocessing
        if size_px:
            width_px, height_px = size_px
            self.preprocessing = replace(self.preprocessing, width_px=width_px, height_px=height_px)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.features = trunk.layers(block)
            maps = self._try_out()
            cells = nn.AdaptiveAvgPool2d(grid) if grid else nn.Identity()
            pooled = Covariance() if covariance else nn.Flatten()
            self.pool = nn.Sequential(cells, Vlad(words, maps.shape[1]) if words else pooled)
            self.fully_connected: nn.Linear | WhitenedLinear
            try:
                self.fully_connected = nn.Linear(self.flatten(maps).shape[1], dimension)
            except RuntimeError as error:
                raise RecognizerError(
                    f"dimension = {dimension}: there is no memory for a layer of so many values"
                ) from error

    @property
    def title(self) -> str:
        """Which layers of which trunk these are, and the size they look at images in."""
        size = f"{self.preprocessing.width_px}x{self.preprocessing.height_px} px"
        return " ".join(filter(None, (self.trunk.name, self.block, f"at {size}")))

    @property
    def dimension(self) -> int:
        """How many values an embedding has."""
        return self.fully_connected.out_features

    def forward(self, images: Tensor) -> Tensor:
        """Return (N, D) embeddings of unit length of (N, 3, height, width) preprocessed images."""
        return self.project(self.features(images))

    def project(self, maps: Tensor) -> Tensor:
        """Return (N, D) embeddings of unit length of the trunk's (N, C, h, w) maps."""
        return functional.normalize(self.fully_connected(self.flatten(maps)))

    def flatten(self, maps: Tensor) -> Tensor:
        """Return the (N, F) values that the fully connected layer sees of (N, C, h, w) maps."""
        flat: Tensor = self.pool(maps)
        return flat

    def prepare(self, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Return the (N, 3, height, width) input made of N uint8 RGB images of any sizes."""
        inputs = torch.from_numpy(np.stack([self.preprocessing(image) for image in images]))
        # The order of numbers in memory that convolutions on a CPU are up to a third faster with.
        return inputs.contiguous(memory_format=torch.channels_last)

    def _try_out(self) -> Tensor:
        """Return the maps of an empty image."""
        height, width = self.preprocessing.height_px, self.preprocessing.width_px
        where = f"trunk {self.trunk.name!r} at {width} x {height} px"
        try:
            with torch.no_grad():
                maps: object = self.features(torch.zeros(1, 3, height, width))
        except RuntimeError as error:
            what = " ".join(str(error).split())
            raise RecognizerError(f"{where} does not run, try larger images: {what}") from error
        if not isinstance(maps, Tensor) or maps.ndim != 4:
            seen = tuple(maps.shape) if isinstance(maps, Tensor) else type(maps).__name__
            raise RecognizerError(f"{where} gives {seen}; it must give (N, C, h, w) maps")
        return maps


def _check(
    dimension: int,
    grid: tuple[int, int] | None,
    words: int | None,
    covariance: bool,
    size_px: tuple[int, int] | None,
) -> None:
    if dimension < 1:
        raise RecognizerError(f"dimension = {dimension}: an embedding needs at least 1 value")
    if dimension > _MOST_VALUES:
        raise RecognizerError(f"dimension = {dimension}: an embedding has {_MOST_VALUES} at most")
    if words is not None and (covariance or words < 2):
        raise RecognizerError(f"words = {words}: 2 or more, and not together with covariance")
    if words is not None and words > _MOST_WORDS:
        raise RecognizerError(f"words = {words}: {_MOST_WORDS} at most")
    sides = (("grid", grid, _MOST_CELLS_A_SIDE), ("size", size_px, _MOST_PX_A_SIDE))
    for name, pair, most in sides:
        if pair is not None and not 1 <= min(pair) <= max(pair) <= most:
            raise RecognizerError(f"{name} = {pair}: both from 1 to {most}")

# SPDX-License-Identifier: Apache-2.0
"""A convolution stack that can be cut after a named block."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from torch import nn

from placerec.errors import RecognizerError
from placerec.networks.preprocessing import Preprocessing


@dataclass(frozen=True)
class Trunk:
    """What stands before the fully connected layer: a known network's layers, or a user's own.

    Attributes:
        name: what a weights file calls it.
        build: makes all layers, from (N, 3, H, W) images to (N, C, h, w) maps.
        preprocessing: how images become such input.
        blocks: where it can be cut: a block's name and how many layers there are up to its end.
            Only for a `nn.Sequential`.
        name_in_file: for a layer's parameter, how the network's published weights call it.
        url: where these can be downloaded.
    """

    name: str
    build: Callable[[], nn.Module]
    preprocessing: Preprocessing
    blocks: Mapping[str, int] = field(default_factory=dict)
    name_in_file: Callable[[str], str] = str
    url: str | None = None

    def layers(self, block: str | None = None) -> nn.Module:
        """Return new layers up to the end of a block, by default all of them.

        Raises:
            RecognizerError: the trunk has no such block.
        """
        layers = self.build()
        if block is None:
            return layers
        count = self.layer_count(block)
        if not isinstance(layers, nn.Sequential):
            raise RecognizerError(f"trunk {self.name!r} is no nn.Sequential and cannot be cut")
        return layers[:count]

    def layer_count(self, block: str) -> int:
        """Return how many layers there are up to the end of a block.

        Raises:
            RecognizerError: the trunk has no such block.
        """
        if block not in self.blocks:
            known = ", ".join(self.blocks) or "none"
            raise RecognizerError(f"trunk {self.name!r} has no block {block!r}; it has: {known}")
        return self.blocks[block]


def with_random_weights(layers: nn.Sequential) -> nn.Sequential:
    """Return a known network's layers, their convolutions drawn so that signals keep their size."""
    for module in layers.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")  # He et al. 2015
    return layers

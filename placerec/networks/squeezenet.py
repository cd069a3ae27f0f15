# SPDX-License-Identifier: Apache-2.0
"""SqueezeNet 1.0's convolutions (Iandola 2016), with the names of its Caffe weights."""

from collections import OrderedDict

import torch
from torch import Tensor, nn

from placerec.networks.preprocessing import CAFFE_INPUT
from placerec.networks.trunk import Trunk, with_random_weights

_SQUEEZED = {2: 16, 3: 16, 4: 32, 5: 32, 6: 48, 7: 48, 8: 64, 9: 64}
"""Channels after squeezing, per fire module; each of its two expansions has four times as many."""
_EXPANSION = 4
_BLOCKS = ["relu1", "pool1", "fire2", "fire3", "fire4", "pool4"]
_BLOCKS += ["fire5", "fire6", "fire7", "fire8", "pool8", "fire9"]


class _Fire(nn.Module):
    """Squeeze to few channels, then expand by two kinds of convolution side by side."""

    def __init__(self, channels_in: int, squeezed: int) -> None:
        super().__init__()
        expanded = _EXPANSION * squeezed
        self.conv1x1_1 = nn.Conv2d(channels_in, squeezed, kernel_size=1)
        self.conv1x1_2 = nn.Conv2d(squeezed, expanded, kernel_size=1)
        self.conv3x3_2 = nn.Conv2d(squeezed, expanded, kernel_size=3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        squeezed = torch.relu(self.conv1x1_1(maps))
        expanded = torch.cat([self.conv1x1_2(squeezed), self.conv3x3_2(squeezed)], dim=1)
        return torch.relu(expanded)


def _layers() -> nn.Sequential:
    pool = nn.MaxPool2d(kernel_size=3, stride=2, ceil_mode=True)
    layers: OrderedDict[str, nn.Module] = OrderedDict(
        conv1=nn.Conv2d(3, 96, kernel_size=7, stride=2), relu1=nn.ReLU(), pool1=pool
    )
    channels = 96
    for number, squeezed in _SQUEEZED.items():
        layers[f"fire{number}"] = _Fire(channels, squeezed)
        channels = 2 * _EXPANSION * squeezed
        if number in (4, 8):
            layers[f"pool{number}"] = pool
    return with_random_weights(nn.Sequential(layers))


def _name_in_file(parameter: str) -> str:
    """Return `fire2/conv1x1_1.weight` for `fire2.conv1x1_1.weight`."""
    layer, kind = parameter.rsplit(".", 1)
    return f"{layer.replace('.', '/')}.{kind}"


SQUEEZENET = Trunk(
    name="squeezenet",
    build=_layers,
    preprocessing=CAFFE_INPUT,
    blocks={name: count for count, name in enumerate(_BLOCKS, 2)},
    name_in_file=_name_in_file,
)

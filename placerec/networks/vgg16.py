# SPDX-License-Identifier: Apache-2.0
"""VGG16's convolutions (Simonyan 2015), laid out as torchvision's so that its weights fit."""

from itertools import accumulate

from torch import nn

from placerec.networks.preprocessing import TORCHVISION_INPUT
from placerec.networks.trunk import Trunk, with_random_weights

_STAGES = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Channels and convolutions between two poolings."""
_BLOCKS = [
    name
    for stage, (_, count) in enumerate(_STAGES, 1)
    for name in (*(f"conv{stage}_{i}" for i in range(1, count + 1)), f"pool{stage}")
]
_LENGTHS = {"conv": 2, "pool": 1}


def _layers() -> nn.Sequential:
    layers: list[nn.Module] = []
    channels_in = 3
    for channels, convolutions in _STAGES:
        for _ in range(convolutions):
            layers += [nn.Conv2d(channels_in, channels, kernel_size=3, padding=1), nn.ReLU()]
            channels_in = channels
        layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
    return with_random_weights(nn.Sequential(*layers))


VGG16 = Trunk(
    name="vgg16",
    build=_layers,
    preprocessing=TORCHVISION_INPUT,
    blocks=dict(zip(_BLOCKS, accumulate(_LENGTHS[name[:4]] for name in _BLOCKS), strict=True)),
    name_in_file="features.{}".format,
    url="https://download.pytorch.org/models/vgg16-397923af.pth",
)

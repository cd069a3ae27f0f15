# SPDX-License-Identifier: Apache-2.0
"""VGG16's convolutions (Simonyan 2015), laid out as torchvision's so that its weights fit."""

from torch import nn

from placerec.networks.preprocessing import IMAGENET_MEAN, IMAGENET_SCALE, Preprocessing
from placerec.networks.trunk import Trunk, with_random_weights

STAGES = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Channels and convolutions between two poolings."""


def _layers() -> nn.Sequential:
    layers: list[nn.Module] = []
    channels_in = 3
    for channels, convolutions in STAGES:
        for _ in range(convolutions):
            layers += [nn.Conv2d(channels_in, channels, kernel_size=3, padding=1), nn.ReLU()]
            channels_in = channels
        layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
    return with_random_weights(nn.Sequential(*layers))


def _blocks() -> dict[str, int]:
    blocks: dict[str, int] = {}
    count = 0
    for stage, (_, convolutions) in enumerate(STAGES, 1):
        for convolution in range(1, convolutions + 1):
            count += 2
            blocks[f"conv{stage}_{convolution}"] = count
        count += 1
        blocks[f"pool{stage}"] = count
    return blocks


VGG16 = Trunk(
    name="vgg16",
    build=_layers,
    preprocessing=Preprocessing(
        width_px=224,
        height_px=224,
        mean=IMAGENET_MEAN,
        scale=IMAGENET_SCALE,
    ),
    blocks=_blocks(),
    name_in_file="features.{}".format,
    url="https://download.pytorch.org/models/vgg16-397923af.pth",
)

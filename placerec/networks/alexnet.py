# SPDX-License-Identifier: Apache-2.0
"""AlexNet's convolutions (Krizhevsky 2014), laid out as torchvision's so that its weights fit."""

from torch import nn

from placerec.networks.preprocessing import IMAGENET_MEAN, IMAGENET_SCALE, Preprocessing
from placerec.networks.trunk import Trunk, with_random_weights


def _layers() -> nn.Sequential:
    layers = nn.Sequential(
        nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(64, 192, kernel_size=5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(192, 384, kernel_size=3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, kernel_size=3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, kernel_size=3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
    )
    return with_random_weights(layers)


ALEXNET = Trunk(
    name="alexnet",
    build=_layers,
    preprocessing=Preprocessing(
        width_px=224,
        height_px=224,
        mean=IMAGENET_MEAN,
        scale=IMAGENET_SCALE,
    ),
    blocks={"conv1": 2, "conv2": 5, "conv3": 8, "conv4": 10, "conv5": 12, "pool5": 13},
    name_in_file="features.{}".format,
    url="https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
)

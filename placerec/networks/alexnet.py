# SPDX-License-Identifier: Apache-2.0
"""AlexNet's convolutions, twice: torchvision's (Krizhevsky 2014) and Caffe's."""

from collections import OrderedDict

from torch import nn

from placerec.networks.preprocessing import CAFFE_INPUT, TORCHVISION_INPUT
from placerec.networks.trunk import Trunk, with_random_weights


def _caffenet() -> nn.Sequential:
    pool = nn.MaxPool2d(kernel_size=3, stride=2, ceil_mode=True)
    norm = nn.LocalResponseNorm(size=5, alpha=1e-4, beta=0.75)
    layers: OrderedDict[str, nn.Module] = OrderedDict(
        conv1=nn.Conv2d(3, 96, kernel_size=11, stride=4),
        relu1=nn.ReLU(),
        pool1=pool,
        norm1=norm,
        conv2=nn.Conv2d(96, 256, kernel_size=5, padding=2, groups=2),
        relu2=nn.ReLU(),
        pool2=pool,
        norm2=norm,
        conv3=nn.Conv2d(256, 384, kernel_size=3, padding=1),
        relu3=nn.ReLU(),
        conv4=nn.Conv2d(384, 384, kernel_size=3, padding=1, groups=2),
        relu4=nn.ReLU(),
        conv5=nn.Conv2d(384, 256, kernel_size=3, padding=1, groups=2),
        relu5=nn.ReLU(),
    )
    return with_random_weights(nn.Sequential(layers))


CAFFENET = Trunk(
    name="caffenet",
    build=_caffenet,
    preprocessing=CAFFE_INPUT,
    blocks={"conv1": 2, "conv2": 6, "conv3": 10, "conv4": 12, "conv5": 14},
)


def _alexnet() -> nn.Sequential:
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
    build=_alexnet,
    preprocessing=TORCHVISION_INPUT,
    blocks={"conv1": 2, "conv2": 5, "conv3": 8, "conv4": 10, "conv5": 12, "pool5": 13},
    name_in_file="features.{}".format,
    url="https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
)

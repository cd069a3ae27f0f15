# SPDX-License-Identifier: Apache-2.0
"""CaffeNet's convolutions, as AMOSNet and HybridNet have them, with the names of Caffe's files."""

from collections import OrderedDict

from torch import nn

from placerec.networks.preprocessing import CAFFE_INPUT
from placerec.networks.trunk import Trunk, with_random_weights


def _pool() -> nn.Module:
    return nn.MaxPool2d(kernel_size=3, stride=2, ceil_mode=True)


def _norm() -> nn.Module:
    return nn.LocalResponseNorm(size=5, alpha=1e-4, beta=0.75)


def _layers() -> nn.Sequential:
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    layers["conv1"] = nn.Conv2d(3, 96, kernel_size=11, stride=4)
    layers.update(relu1=nn.ReLU(), pool1=_pool(), norm1=_norm())
    layers["conv2"] = nn.Conv2d(96, 256, kernel_size=5, padding=2, groups=2)
    layers.update(relu2=nn.ReLU(), pool2=_pool(), norm2=_norm())
    layers["conv3"] = nn.Conv2d(256, 384, kernel_size=3, padding=1)
    layers["relu3"] = nn.ReLU()
    layers["conv4"] = nn.Conv2d(384, 384, kernel_size=3, padding=1, groups=2)
    layers["relu4"] = nn.ReLU()
    layers["conv5"] = nn.Conv2d(384, 256, kernel_size=3, padding=1, groups=2)
    layers["relu5"] = nn.ReLU()
    return with_random_weights(nn.Sequential(layers))


CAFFENET = Trunk(
    name="caffenet",
    build=_layers,
    preprocessing=CAFFE_INPUT,
    blocks={"conv1": 2, "conv2": 6, "conv3": 10, "conv4": 12, "conv5": 14},
)

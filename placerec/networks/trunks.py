# SPDX-License-Identifier: Apache-2.0
"""The trunks that weights may name."""

from placerec.networks.alexnet import ALEXNET
from placerec.networks.mobilenet_v2 import MOBILENET_V2
from placerec.networks.squeezenet import SQUEEZENET
from placerec.networks.vgg16 import VGG16

TRUNKS = {trunk.name: trunk for trunk in (ALEXNET, VGG16, SQUEEZENET, MOBILENET_V2)}

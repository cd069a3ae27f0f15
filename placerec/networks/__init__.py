# SPDX-License-Identifier: Apache-2.0
"""Networks that turn an image into a point on the unit sphere."""

from placerec.networks.alexnet import ALEXNET
from placerec.networks.mobilenet_v2 import MOBILENET_V2
from placerec.networks.place_network import PlaceNetwork
from placerec.networks.preprocessing import Preprocessing
from placerec.networks.squeezenet import SQUEEZENET
from placerec.networks.trunk import Trunk
from placerec.networks.vgg16 import VGG16

TRUNKS = {trunk.name: trunk for trunk in (ALEXNET, VGG16, SQUEEZENET, MOBILENET_V2)}

__all__ = ["TRUNKS", "PlaceNetwork", "Preprocessing", "Trunk"]

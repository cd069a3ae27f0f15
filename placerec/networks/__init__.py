# SPDX-License-Identifier: Apache-2.0
"""Networks that turn an image into a point on the unit sphere.

A name is loaded when it is first used: who only prepares images does not take torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from placerec.networks.place_network import PlaceNetwork as PlaceNetwork
    from placerec.networks.preprocessing import Preprocessing as Preprocessing
    from placerec.networks.trunk import Trunk as Trunk
    from placerec.networks.trunks import TRUNKS as TRUNKS

_HOME = {
    "PlaceNetwork": "placerec.networks.place_network",
    "Preprocessing": "placerec.networks.preprocessing",
    "TRUNKS": "placerec.networks.trunks",
    "Trunk": "placerec.networks.trunk",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)

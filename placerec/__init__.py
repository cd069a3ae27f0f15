# SPDX-License-Identifier: Apache-2.0
"""What a place looks like: recognizers that turn an image into a point on the unit sphere.

What is named here stays; everything else may move from one version to the next. A name is loaded
when it is first used: only those that learn take torch.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from placerec.conformance import check as check
    from placerec.errors import LoopcloseError as LoopcloseError
    from placerec.errors import RecognizerError as RecognizerError
    from placerec.networks import TRUNKS as TRUNKS
    from placerec.networks import PlaceNetwork as PlaceNetwork
    from placerec.networks import Preprocessing as Preprocessing
    from placerec.networks import Trunk as Trunk
    from placerec.networks.pretrained import download_pretrained as download_pretrained
    from placerec.places.rows import SeenPlace as SeenPlace
    from placerec.places.store import PlaceStore as PlaceStore
    from placerec.recognizer import PlaceRecognizer as PlaceRecognizer
    from placerec.recognizer import available as available
    from placerec.recognizer import load as load
    from placerec.training.config import TrainingConfig as TrainingConfig
    from placerec.training.loop import Training as Training

    __version__: str

_HOME = {
    "LoopcloseError": "placerec.errors",
    "TRUNKS": "placerec.networks",
    "PlaceNetwork": "placerec.networks",
    "PlaceRecognizer": "placerec.recognizer",
    "PlaceStore": "placerec.places.store",
    "Preprocessing": "placerec.networks",
    "RecognizerError": "placerec.errors",
    "SeenPlace": "placerec.places.rows",
    "Training": "placerec.training.loop",
    "TrainingConfig": "placerec.training.config",
    "Trunk": "placerec.networks",
    "available": "placerec.recognizer",
    "check": "placerec.conformance",
    "download_pretrained": "placerec.networks.pretrained",
    "load": "placerec.recognizer",
}

__all__ = sorted([*_HOME, "__version__"])


def __getattr__(name: str) -> object:
    if name == "__version__":
        return version("loopclose")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__

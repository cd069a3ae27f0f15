# SPDX-License-Identifier: Apache-2.0
"""The default network, run by onnxruntime where that is installed, and by torch otherwise.

onnxruntime takes less time per image, and starts without torch, which takes seconds. Which of them
it is depends on what is installed alone, never on a measurement; embeddings change by less than
1e-5.
"""

import hashlib
import logging
from importlib.util import find_spec

from placerec.errors import RecognizerError
from placerec.files import is_file
from placerec.networks.device import device_asked_for, on_another
from placerec.recognizer import ONNX_SUFFIX, PlaceRecognizer
from placerec.recognizers.fitted_file import NETWORKS_TRAINED_ON, shipped
from placerec.recognizers.onnx_file import OnnxRecognizer

DEFAULT_NAME = "learned"
DEFAULT_WEIGHTS = shipped("default")
DEFAULT_GRAPH = DEFAULT_WEIGHTS.with_suffix(ONNX_SUFFIX)
"""How the network is computed; its tensors are those in DEFAULT_WEIGHTS."""
WEIGHTS_METADATA = "weights sha256"
_log = logging.getLogger(__name__)


def open_default() -> PlaceRecognizer:
    """Return the default recognizer.

    Raises:
        RecognizerError: its weights are not installed or damaged.
    """
    device_asked_for()  # what is no name of a device at all is not for torch to tell
    if find_spec("onnxruntime") and is_file(DEFAULT_GRAPH) and is_file(DEFAULT_WEIGHTS):
        try:
            return DefaultByOnnx()
        except RecognizerError as error:
            _log.warning("torch is to run the default recognizer, because %s", error)
    # Loaded here, because torch takes seconds that onnxruntime does not need.
    from placerec.recognizers.learned import LearnedRecognizer

    return LearnedRecognizer()


class DefaultByOnnx(OnnxRecognizer):
    """The default network, run by onnxruntime.

    Attributes:
        trained_on: names of datasets.
    """

    trained_on = NETWORKS_TRAINED_ON

    def __init__(self) -> None:
        """Open the graph on the weights.

        Raises:
            RecognizerError: onnxruntime cannot run it, or it is of other weights.
        """
        super().__init__(DEFAULT_GRAPH)
        with DEFAULT_WEIGHTS.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        if self.metadata.get(WEIGHTS_METADATA) != digest:
            # Where in the file each tensor lies would be another place.
            raise RecognizerError(f"the graph is of other weights: {DEFAULT_GRAPH}")
        of_package = f"{self.metadata['title']}, trained for places: those of the package"
        self.weights = of_package + on_another()

    @property
    def fingerprint(self) -> str:
        """Its weights', as torch runs them."""
        return self.metadata["fingerprint"]

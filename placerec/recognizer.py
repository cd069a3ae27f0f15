# SPDX-License-Identifier: Apache-2.0
"""The one interface between a way of recognising places and everything that uses it."""

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class RecognizerError(Exception):
    """A recognizer that cannot be found or misbehaves: one line that says what and whose."""


@runtime_checkable
class PlaceRecognizer(Protocol):
    """Turns an image into a point on the unit sphere; near points are the same place.

    Attributes:
        min_similarity: cosine from which a match is worth verifying, calibrated for this method.
    """

    min_similarity: float

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image."""
        ...

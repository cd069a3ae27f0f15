# SPDX-License-Identifier: Apache-2.0
"""What a run keeps of its keyframes, so that their loops can be decided again."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.mapping.landmark_map import LandmarkMap


@dataclass(frozen=True)
class Remembered:
    """What keyframes showed: enough to look for their loops again, and to adjust the map.

    Attributes:
        min_similarity: the recognizer's own.
        embeddings: (K, D) float32, of unit length.
        the_map: its keyframes have their features.
    """

    min_similarity: float
    embeddings: NDArray[np.float32]
    the_map: LandmarkMap

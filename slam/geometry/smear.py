# SPDX-License-Identifier: Apache-2.0
"""Whether the motion of the camera has smeared an image: by how sharp its images usually are."""

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled
from slam.types import Rejection, RejectionReason

# An image this much less sharp than the last so many are is smeared. The least sharp images of
# fr1_desk, fr1_xyz and the demo have 0.64, 0.78 and 0.67 of that; with smears of 5 % of the width
# it is 0.45.
_SMEARED, _USUAL_IMAGES = 0.6, 30
_FINE_PX, _COARSE_PX = (160, 120), (40, 30)
_BLANK = 1.0  # squared slope of the coarse image, of up to 255 grey levels; pictures have thousands


class SmearFinder:
    """Remembers how sharp the last images of a camera were."""

    def __init__(self) -> None:
        self._sharpness: list[float] = []

    def find(self, grey: NDArray[np.uint8]) -> Rejection | None:
        """Take the next (H, W) image and say if it is smeared by far more than others are.

        A corner may then be seen anywhere along its smear, and all agree on the wrong place.
        """
        sharp = sharpness(grey)
        if np.isinf(sharp):  # blank, which is for others to say
            return None
        self._sharpness = [*self._sharpness, sharp][-_USUAL_IMAGES:]
        needed = _SMEARED * float(np.median(self._sharpness))
        return Rejection(RejectionReason.SMEARED, sharp, needed) if sharp < needed else None


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Return how much fine structure a (H, W) image has, of what its coarse structure promises.

    Both are the edges across which the fewest are: a smear takes away those across its direction,
    and the fine ones first. What the image shows has little influence. An image without structure
    has none that could be smeared: infinite.
    """
    fine = cv2.resize(grey, _FINE_PX, interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(fine, _COARSE_PX, interpolation=cv2.INTER_AREA)
    promised = _weakest_edges(coarse)
    return float(np.sqrt(_weakest_edges(fine) / promised)) if promised > _BLANK else np.inf


def _weakest_edges(grey: cv2.typing.MatLike) -> float:
    """Return the mean squared slope in the direction in which that is least."""
    across, down = (np.asarray(each, np.int16) for each in cv2.spatialGradient(grey))
    across_squared, both, down_squared = _covariance(across, down)
    mean, difference = (across_squared + down_squared) / 2, (across_squared - down_squared) / 2
    return max(mean - float(np.hypot(difference, both)), 0.0)


@compiled
def _covariance(a: NDArray[np.int16], b: NDArray[np.int16]) -> tuple[float, float, float]:
    """Return the variance of (H, W) values, their covariance with others, and those' variance."""
    sum_a = sum_b = sum_aa = sum_ab = sum_bb = 0.0
    for row in range(a.shape[0]):
        for column in range(a.shape[1]):
            x, y = float(a[row, column]), float(b[row, column])
            sum_a, sum_b = sum_a + x, sum_b + y
            sum_aa, sum_ab, sum_bb = sum_aa + x * x, sum_ab + x * y, sum_bb + y * y
    mean_a, mean_b = sum_a / a.size, sum_b / a.size
    return (
        sum_aa / a.size - mean_a * mean_a,
        sum_ab / a.size - mean_a * mean_b,
        sum_bb / a.size - mean_b * mean_b,
    )

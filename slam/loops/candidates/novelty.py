# SPDX-License-Identifier: Apache-2.0
"""Which keyframes of a large map stand for their places, so that a known place grows no more.

A keyframe shows nothing new where loops found, in others that are kept, nearly all of what it
shows: ORB-SLAM's rule (Mur-Artal et al. 2015), by verified loops instead of shared landmarks. Its
loops hold as any other's do, but it is no candidate for later ones. So queries stay as fast as they
are where the camera goes round in places that it knows, and what its loops tie together stays few.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.types import Camera, IntArray, Keyframe, LoopAttempt

_ALL_KEPT = 500
"""Keyframes of a map that is small enough to be adjusted at once: none of them is left out."""
_CELLS = 8  # across the image
_SEEN_BY = 2  # others that have to show a part of the image
_SEEN_SHARE = 0.75  # of the parts that show anything; at the rim there are some in one view alone


class Novelty:
    """Tells keyframes that show something new from those that do not.

    The latter are told apart from the first keyframe on, and left out once there are too many.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._kept: set[int] = set()
        self._count = 0

    @property
    def kept(self) -> IntArray:
        """The keyframes so far that showed something new, in order."""
        return np.array(sorted(self._kept), np.int64)

    def load(self, is_new: NDArray[np.bool_]) -> IntArray:
        """Take (K,) keyframes of an earlier map, and return those that are candidates of later."""
        self._kept = set(np.flatnonzero(is_new).tolist())
        self._count = len(is_new)
        return self.kept if self._count >= _ALL_KEPT else np.arange(self._count)

    def is_new(self, keyframe: Keyframe, attempts: Sequence[LoopAttempt]) -> bool:
        """Take the next keyframe with its loop candidates, and return whether to keep it."""
        self._count += 1
        if self._shows_something_new(keyframe, attempts):
            self._kept.add(keyframe.id)
        return self._count <= _ALL_KEPT or keyframe.id in self._kept

    def chosen(self) -> IntArray | None:
        """Return the keyframes to go on with, at the moment when there are too many, else None."""
        return self.kept if self._count == _ALL_KEPT else None

    def _shows_something_new(self, keyframe: Keyframe, attempts: Sequence[LoopAttempt]) -> bool:
        width = (keyframe.camera or self._camera).width
        seen = np.zeros(0, np.int64)
        for each in attempts:
            if each.rejection is None and each.verification and each.match_id in self._kept:
                pixels = each.verification.pixels[each.verification.inlier_mask, 2:]
                seen = np.append(seen, np.unique(_cells(pixels, width)))
        shown = np.unique(_cells(keyframe.features.pixels, width))
        cells, by = np.unique(seen, return_counts=True)
        seen_again = int(np.isin(shown, cells[by >= _SEEN_BY]).sum())
        return seen_again < _SEEN_SHARE * max(1, len(shown))


def _cells(pixels: NDArray[np.floating], width: int) -> IntArray:
    """Return the number of the part of the image, so wide, that (N, 2) pixels are in."""
    cells = (pixels * (_CELLS / width)).astype(np.int64)
    return np.asarray(cells[:, 0] + 1000 * cells[:, 1])

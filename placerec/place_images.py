# SPDX-License-Identifier: Apache-2.0
"""What a training is given to learn from."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class PlaceImages(Protocol):
    """Images, each with the place that it shows."""

    @property
    def places(self) -> NDArray[np.int64] | None:
        """(n,) int64, a label per image: one per place; None cannot be learned from."""
        ...

    @property
    def scenes(self) -> NDArray[np.int64]:
        """(n,) int64, a label per image: one per room, building or recording."""
        ...

    @property
    def collections(self) -> NDArray[np.int64]:
        """(n,) int64, a label per image: one per kind of images, each to count the same."""
        ...

    def alike(self, indices: NDArray[np.int64], /) -> NDArray[np.bool_]:
        """Return (m, m) bool for m images: pairs that may show one place whatever their labels."""
        ...

    def __getitem__(self, index: int, /) -> NDArray[np.uint8]:
        """Return an image, (H, W, 3) uint8 RGB, of any size."""
        ...

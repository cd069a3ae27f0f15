# SPDX-License-Identifier: Apache-2.0
"""A recognizer of your own: a class with two members that imports nothing of this project."""

import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 6, 8


class ColourLayout:
    """Recognises a place by the mean colour of each part of the image."""

    min_similarity = 0.9

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (145,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image."""
        parts = [
            part.mean(axis=(0, 1))
            for row in np.array_split(image, ROWS)
            for part in np.array_split(row, COLUMNS, axis=1)
        ]
        colours = np.ravel(parts)
        # Against the mean, brightness and contrast do not count; the first value keeps a plain
        # image, whose parts do not differ, from having no length.
        layout = np.append(1e-3, colours - colours.mean())
        embedding: NDArray[np.float32] = (layout / np.linalg.norm(layout)).astype(np.float32)
        return embedding

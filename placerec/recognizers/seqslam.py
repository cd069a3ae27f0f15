# SPDX-License-Identifier: Apache-2.0
"""SeqSLAM: a place is told not by one image, but by the images on the way to it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import CheckedRecognizer, Embeddings, Similarities
from placerec.recognizer import PlaceRecognizer

_THUMBNAIL_PX = (64, 32)
_PATCH_PX = 8
_SEQUENCE = 10
_NEIGHBOURS = 10
_SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)
"""All as Milford and Wyeth 2012 have them."""
_FAINT = 1e-6


class Thumbnails:
    """Thumbnails whose every patch has the same brightness and contrast, compared by the cosine."""

    min_similarity: float = 0.23
    fingerprint = f"thumbnails of {_THUMBNAIL_PX} px, patches of {_PATCH_PX} px"
    weights = "thumbnails, no weights"

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (2049,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image.

        The last value is what is left of an image without any contrast, and 0 in others.
        """
        small = cv2.resize(image, _THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.float64)
        rows, columns = (side // _PATCH_PX for side in grey.shape)
        patches = grey.reshape(rows, _PATCH_PX, columns, _PATCH_PX)
        centred = patches - patches.mean(axis=(1, 3), keepdims=True)
        contrast = centred.std(axis=(1, 3), keepdims=True)
        normalised = np.where(contrast > 0.0, centred / np.maximum(contrast, _FAINT), 0.0)
        vector = np.append(normalised, 0.0 if normalised.any() else 1.0)
        return np.asarray(vector / np.linalg.norm(vector), np.float32)


class SeqSlam:
    """Any recognizer of single images, made to compare the sequences that lead up to them.

    How much more an image resembles a reference than the references seen around that one is added
    up along straight paths through the latest images and the references, at several speeds; the
    best path counts (Milford and Wyeth 2012). One may come back the other way, so paths lead both
    ways through the references.

    Attributes:
        min_similarity: 1 % of the pairs of images of different validation floors of ie_tower are as
            similar, with thumbnails; with another recognizer it may be another.
        weights, trained_on, fingerprint: of the recognizer of single images.
    """

    min_similarity: float = 0.3
    looks_back = _SEQUENCE - 1

    def __init__(self, recognizer: PlaceRecognizer | None = None) -> None:
        """Wrap a recognizer, by default of patch-normalised thumbnails."""
        single = Thumbnails() if recognizer is None else recognizer
        self._checked = CheckedRecognizer(single)
        of = getattr(single, "weights", "") or type(single).__name__
        self.weights = f"sequences of {_SEQUENCE}: {of}"
        self.trained_on: tuple[str, ...] = tuple(getattr(single, "trained_on", ()))
        self.fingerprint: str | None = getattr(single, "fingerprint", None)

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the float32 embedding of a (H, W, 3) uint8 RGB image, as the recognizer has it."""
        return self._checked.embed(image)

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return (Q, R) float32, -1 to 1, of embeddings in the order in which they were seen.

        Where a path leaves the references, or begins before the first query, nothing speaks for it
        or against it.
        """
        contrast = stand_out(self._checked.compare(queries, references))
        rows, columns = contrast.shape
        best = np.full(contrast.shape, -np.inf)
        margin = round(max(_SPEEDS) * (_SEQUENCE - 1))
        wide = np.pad(contrast, ((0, 0), (margin, margin)))
        for speed in (*_SPEEDS, *(-speed for speed in _SPEEDS)):
            along = np.zeros(contrast.shape)
            for back in range(min(_SEQUENCE, rows)):
                start = margin - round(speed * back)
                along[back:] += wide[: rows - back, start : start + columns]
            best = np.maximum(best, along)
        return np.asarray(best / _SEQUENCE, np.float32)


def stand_out(similarities: Similarities) -> NDArray[np.float64]:
    """Return by how much (Q, R) similarities stand out among those of neighbouring references.

    In standard deviations, over the most that there can be among so many: -1 to 1.
    """
    count = similarities.shape[1]
    columns = np.arange(count)
    first = np.maximum(columns - _NEIGHBOURS // 2, 0)
    last = np.minimum(columns + _NEIGHBOURS // 2 + 1, count)
    sizes = (last - first).astype(np.float64)
    values = similarities.astype(np.float64)
    sums, squares = (np.pad(each.cumsum(axis=1), ((0, 0), (1, 0))) for each in (values, values**2))
    mean = (sums[:, last] - sums[:, first]) / sizes
    variance = (squares[:, last] - squares[:, first]) / sizes - mean**2
    spread = np.sqrt(np.maximum(variance, 0.0) * np.maximum(sizes - 1.0, 1.0))
    return np.asarray(np.clip((values - mean) / np.maximum(spread, _FAINT), -1.0, 1.0))

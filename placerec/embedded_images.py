# SPDX-License-Identifier: Apache-2.0
"""The images of a dataset as a recognizer sees them, and how long that took."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from placerec.datasets import PlaceDataset
from placerec.embedding_cache import EmbeddingCache
from placerec.recognizer import CheckedRecognizer, PlaceRecognizer, RecognizerError

Progress = Callable[[int, int], None]
"""Called with how many images are done, and of how many."""


@dataclass(frozen=True)
class EmbeddedImages:
    """What a recognizer makes of N images.

    Attributes:
        embeddings: (N, *S) float32.
        seconds: (N,) float64, how long each took when it was made.
        oldest: the day the oldest was made on by an earlier run, None where all are of this one.
    """

    embeddings: NDArray[np.float32]
    seconds: NDArray[np.float64]
    oldest: date | None = None


def embed_dataset(
    recognizer: PlaceRecognizer,
    dataset: PlaceDataset,
    cache: EmbeddingCache | None = None,
    progress: Progress | None = None,
) -> EmbeddedImages:
    """Embed a dataset's images, those in the cache without looking at them again.

    Raises:
        RecognizerError: the recognizer fails or breaks its protocol, or an image cannot be read.
    """
    checked = CheckedRecognizer(recognizer)
    vectors, seconds, days = [], [], []
    for i, path in enumerate(dataset.paths):
        kept = cache.find(path) if cache else None
        if kept is None:
            vector, took_s = _embed(checked, dataset[i])
            if cache:
                cache.keep(path, vector, took_s)
        else:
            vector, took_s = kept.vector, kept.seconds
            days += [kept.made_on] if kept.made_on else []
        vectors.append(vector)
        seconds.append(took_s)
        if progress:
            progress(i + 1, len(dataset))
    if len({vector.shape for vector in vectors}) > 1:
        raise RecognizerError(
            "embeddings kept from before have another shape; change the recognizer's fingerprint "
            "whenever its embeddings change"
        )
    return EmbeddedImages(np.stack(vectors), np.array(seconds), min(days, default=None))


def _embed(
    checked: CheckedRecognizer, image: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], float]:
    start = perf_counter()
    vector = checked.embed(image)
    return vector, perf_counter() - start

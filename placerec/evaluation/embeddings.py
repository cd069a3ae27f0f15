# SPDX-License-Identifier: Apache-2.0
"""Embeddings of image files, kept between runs; what is damaged is as if it had never been kept."""

import hashlib
import io
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import own_fingerprint
from placerec.checked_recognizer import CheckedRecognizer
from placerec.datasets import PlaceDataset
from placerec.errors import LoopcloseError, RecognizerError
from placerec.files import Progress, cache_folder, write_atomically
from placerec.networks.device import images_at_once, on_another
from placerec.recognizer import PlaceRecognizer

_LIBRARIES = ("loopclose", "numpy", "opencv-python-headless", "torch", "onnxruntime")
"""With another version of these, the last digits of an embedding may be others."""
_STARTED_S = time.time()
_FORMAT = "seconds, time, npy"
_FACTS = struct.Struct("<dd")
_DIGEST_BYTES = hashlib.sha256().digest_size


class KeptEmbedding(NamedTuple):
    """An embedding, float32 of any shape, and how long it took to make.

    The day is that on which an earlier run made it, None where this one did.
    """

    vector: NDArray[np.float32]
    seconds: float
    made_on: date | None


class EmbeddingCache:
    """What one recognizer made of image files, by their content; wherever they lie, however named.

    Only a recognizer with a member `fingerprint: str`, which changes when its embeddings do, has
    one: of others nobody knows whether they still are what they were.
    """

    def __init__(self, recognizer: PlaceRecognizer, folder: Path | None = None) -> None:
        """Open the recognizer's part of a folder, by default that of the user.

        Raises:
            RecognizerError: the recognizer has no fingerprint.
        """
        fingerprint, kind = own_fingerprint(recognizer), type(recognizer)
        if fingerprint is None:
            raise RecognizerError(f"{kind.__name__!r} has no fingerprint: str")
        libraries = [f"{name} {installed_version(name) or 'unknown'}" for name in _LIBRARIES]
        made_by = f"{kind.__module__}:{kind.__qualname__}{on_another()}"
        facts = [_FORMAT, fingerprint, made_by, *libraries]
        key = hashlib.sha256("\n".join(facts).encode()).hexdigest()[:32]
        self._folder = (folder or cache_folder()) / "embeddings" / key
        self._is_writable = True

    def find(self, image: Path) -> KeptEmbedding | None:
        """Return what was kept of an image file, None where that is nothing, or damaged."""
        try:
            content = self._file(image).read_bytes()
        except OSError:
            return None
        digest, facts = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if hashlib.sha256(facts).digest() != digest:
            return None
        seconds, made_s = _FACTS.unpack_from(facts)
        vector = np.load(io.BytesIO(facts[_FACTS.size :]), allow_pickle=False)
        made_on = date.fromtimestamp(made_s) if made_s < _STARTED_S else None
        return KeptEmbedding(vector, seconds, made_on)

    def keep(self, image: Path, vector: NDArray[np.float32], seconds: float) -> None:
        """Keep an image file's embedding, made just now; where that cannot be, it is let go."""
        if not self._is_writable:
            return
        array = io.BytesIO()
        np.save(array, vector.astype(np.float32), allow_pickle=False)
        facts = _FACTS.pack(seconds, time.time()) + array.getvalue()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._file(image), hashlib.sha256(facts).digest() + facts)
        except (OSError, LoopcloseError):
            self._is_writable = False  # a full disk is not asked again for every image

    def _file(self, image: Path) -> Path:
        return self._folder / hashlib.sha256(image.read_bytes()).hexdigest()


def installed_version(package: str) -> str | None:
    """Return the version of a package, None for a checkout or another build of it (OpenCV)."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


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

    Of several that go at once, each has taken an equal part of their time.

    Raises:
        RecognizerError: the recognizer fails or breaks its protocol, or an image cannot be read.
    """
    checked = CheckedRecognizer(recognizer)
    at_once = images_at_once()
    every: list[KeptEmbedding] = []
    for first in range(0, len(dataset), at_once):
        numbers = range(first, min(first + at_once, len(dataset)))
        kept = [cache.find(dataset.paths[i]) if cache else None for i in numbers]
        anew = [i for i, found in zip(numbers, kept, strict=True) if found is None]
        made = iter(_embedded(checked, [dataset[i] for i in anew]))
        for i, found in zip(numbers, kept, strict=True):
            each = found or next(made)
            if cache and not found:
                cache.keep(dataset.paths[i], each.vector, each.seconds)
            every.append(each)
        if progress:
            progress(len(every), len(dataset))
    vectors, seconds, days = zip(*every, strict=True)
    if len({vector.shape for vector in vectors}) > 1:
        raise RecognizerError(
            "embeddings kept from before have another shape; change the recognizer's fingerprint "
            "whenever its embeddings change"
        )
    earlier = [day for day in days if day]
    return EmbeddedImages(np.stack(vectors), np.array(seconds), min(earlier, default=None))


def _embedded(
    checked: CheckedRecognizer, images: Sequence[NDArray[np.uint8]]
) -> list[KeptEmbedding]:
    """Return what is made of images just now."""
    start = perf_counter()
    vectors = checked.embed_many(images)
    took_s = (perf_counter() - start) / max(1, len(images))
    return [KeptEmbedding(vector, took_s, None) for vector in vectors]

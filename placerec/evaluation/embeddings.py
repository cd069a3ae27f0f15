# SPDX-License-Identifier: Apache-2.0
"""Embeddings of image files, kept between runs; what is damaged is as if it had never been kept."""

import hashlib
import io
import struct
import time
from dataclasses import dataclass
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import CheckedRecognizer
from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.files import Progress, cache_folder, write_atomically
from placerec.recognizer import PlaceRecognizer

LIBRARIES = ("loopclose", "numpy", "opencv-python-headless", "torch")
"""With another version of these, the last digits of an embedding may be others."""
_STARTED_S = time.time()
FORMAT = "seconds, time, npy"
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
        fingerprint = fingerprint_of(recognizer)
        if fingerprint is None:
            raise RecognizerError(f"{type(recognizer).__name__!r} has no fingerprint: str")
        root = cache_folder() if folder is None else folder
        self._folder = root / "embeddings" / _recognizer_key(recognizer, fingerprint)
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
        except (OSError, RecognizerError):
            self._is_writable = False  # a full disk is not asked again for every image

    def _file(self, image: Path) -> Path:
        return self._folder / hashlib.sha256(image.read_bytes()).hexdigest()


def fingerprint_of(recognizer: PlaceRecognizer) -> str | None:
    """Return what a recognizer says that its embeddings depend on, None where it says nothing."""
    own = getattr(recognizer, "fingerprint", None)
    return own if isinstance(own, str) else None


def _recognizer_key(recognizer: PlaceRecognizer, fingerprint: str) -> str:
    kind = type(recognizer)
    made_by = [f"{library} {_version(library)}" for library in LIBRARIES]
    facts = "\n".join([FORMAT, fingerprint, f"{kind.__module__}:{kind.__qualname__}", *made_by])
    return hashlib.sha256(facts.encode()).hexdigest()[:32]


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:  # a checkout that was not installed, or another build of OpenCV
        return "unknown"


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

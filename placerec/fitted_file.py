# SPDX-License-Identifier: Apache-2.0
"""What a recognizer learned from images, as one safetensors file that says whose it is."""

import hashlib
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from placerec.certificate import Certificate, certificate_path, write_certificate
from placerec.output_file import write_atomically
from placerec.recognizer import ENTRY_POINT_GROUP, PlaceRecognizer, RecognizerError, find

METADATA_KEY = "placerec.fitted"
NETWORK_READER = "placerec.embedding:LearnedRecognizer"
"""Of every file that is not ours: found when it is needed, because it takes torch."""

Array = NDArray[Any]


@runtime_checkable
class FittedRecognizer(Protocol):
    """A recognizer with words, principal components or the like, found in images.

    Attributes:
        min_similarity: as of any recognizer; what was calibrated is set before it is saved.
        trained_on: names of the datasets that it learned from, told before it is saved.
    """

    min_similarity: float
    trained_on: tuple[str, ...]

    def fit(self, images: Iterable[NDArray[np.uint8]], seed: int) -> None:
        """Learn from (H, W, 3) uint8 RGB images, which are handed over once, one by one."""
        ...

    def save(self, path: Path) -> None:
        """Write all that was learned to a file, which names the recognizer from then on."""
        ...


class Fitted(BaseModel):
    """What stands beside the arrays.

    Attributes:
        recognizer: the name that it is installed by.
        min_similarity: cosine from which a match is worth verifying.
        trained_on: names of datasets.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    recognizer: str = Field(pattern=r"^[\w.-]+$")  # a file must not name code to run
    min_similarity: float = Field(ge=-1.0, le=1.0)
    trained_on: tuple[str, ...] = ()


def write_fitted(path: Path, fitted: Fitted, arrays: Mapping[str, Array]) -> None:
    """Write what a recognizer learned; the same arrays, the same bytes.

    Raises:
        RecognizerError: the file cannot be written.
    """
    content = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_atomically(path, save(content, {METADATA_KEY: fitted.model_dump_json()}))


def read_fitted(path: Path, recognizer: str) -> tuple[Fitted, dict[str, Array]]:
    """Return what a recognizer learned.

    Raises:
        RecognizerError: the file cannot be read, or is not of this recognizer.
    """
    remedy = f"`placerec fit {recognizer} FOLDER --out FILE` makes one"
    if not path.is_file():
        raise RecognizerError(f"there is no file of what {recognizer} learned; {remedy}: {path}")
    try:
        with safe_open(path, framework="np") as file:
            fitted = Fitted.model_validate_json((file.metadata() or {})[METADATA_KEY])
            names = file.keys()
            arrays = {name: file.get_tensor(name) for name in names}
    except (OSError, SafetensorError, KeyError, ValidationError) as error:
        raise RecognizerError(f"not a whole file of {recognizer}; {remedy}: {path}") from error
    if fitted.recognizer != recognizer:
        raise RecognizerError(f"the file is of {fitted.recognizer}, not of {recognizer}: {path}")
    return fitted, arrays


def keep_calibration_of(recognizer: FittedRecognizer, path: Path, certificate: Certificate) -> Path:
    """Give a recognizer's file the calibrated threshold, and return the certificate's path.

    Raises:
        RecognizerError: one of the files cannot be written.
    """
    beside = certificate_path(path)
    write_certificate(certificate, beside)
    recognizer.min_similarity = certificate.min_similarity
    recognizer.save(path)
    return beside


def open_recognizer(path: Path) -> PlaceRecognizer:
    """Return the recognizer whose file it is: a trained network, or one with what it learned.

    Raises:
        RecognizerError: the file cannot be read, or its recognizer is not installed.
    """
    owner = _owner(path)
    network = EntryPoint(name=str(path), value=NETWORK_READER, group=ENTRY_POINT_GROUP)
    reader = network if owner is None else find(owner)
    return cast(PlaceRecognizer, reader.load()(path))


def hash_arrays(arrays: Mapping[str, Array], *facts: object) -> str:
    """Return "sha256:..." of arrays and of whatever else embeddings depend on."""
    digest = hashlib.sha256(repr(facts).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{digest.hexdigest()}"


def _owner(path: Path) -> str | None:
    try:
        with safe_open(path, framework="np") as file:
            return Fitted.model_validate_json(file.metadata()[METADATA_KEY]).recognizer
    except (OSError, SafetensorError, KeyError, TypeError, ValidationError):
        return None  # the other reader says what is wrong with it

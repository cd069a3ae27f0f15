# SPDX-License-Identifier: Apache-2.0
"""What a recognizer learned from images without labels, as one file that says whose it is."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from placerec.certificate import (
    Certificate,
    certificate_beside,
    certificate_path,
    write_certificate,
)
from placerec.errors import RecognizerError, cause_of
from placerec.files import MOST_WEIGHTS_BYTES, check_file, is_file, write_atomically
from placerec.recognizer import (
    ENTRY_POINT_GROUP,
    WEIGHTS_SUFFIX,
    PlaceRecognizer,
    find,
    imported,
)

NETWORKS_TRAINED_ON = ("ie_tower:train",)
"""Of what is measured on, what the shipped networks have seen: see their model card."""
METADATA_KEY = "placerec.fitted"
_NETWORK_READER = "placerec.recognizers.learned:LearnedRecognizer"
"""Of every file that is not ours: found when it is needed, because it takes torch."""


@dataclass(frozen=True)
class Fitted:
    """What was learned: words, principal components or the like.

    Attributes:
        arrays: by name.
        facts: whatever else must be known to use them, such as the layer that they belong to.
        trained_on: names of the datasets that it was learned from.
        min_similarity: similarity from which a match is worth verifying.
    """

    arrays: Mapping[str, NDArray[Any]]
    facts: Mapping[str, str] = field(default_factory=dict)
    trained_on: tuple[str, ...] = ()
    min_similarity: float = 0.0

    @property
    def source(self) -> str:
        """What it was learned from, for people."""
        return ", ".join(self.trained_on) or "unknown images"

    @property
    def fingerprint(self) -> str:
        """Changes whenever what was learned does."""
        digest = hashlib.sha256(repr(sorted(self.facts.items())).encode())
        for name, array in sorted(self.arrays.items()):
            digest.update(f"{name} {array.dtype} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return f"sha256:{digest.hexdigest()}"


class _Description(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    recognizer: str = Field(pattern=r"^[\w.-]+$")  # a file must not name code to run
    min_similarity: float = Field(ge=-1.0, le=1.0)
    trained_on: tuple[str, ...]
    facts: dict[str, str]


class FittedRecognizer:
    """What recognizers that learn from images without labels have in common: their file.

    Attributes:
        name: what it is installed as.
        min_similarity: of what was learned; by the class, before it is calibrated.
        trained_on, fingerprint: of what was learned.
    """

    name: ClassVar[str]
    min_similarity: float
    _path: Path | None

    def __init__(self, path: Path | None = None) -> None:
        """Read what was learned, by default what comes with the package.

        Raises:
            RecognizerError: the file or the weights it goes with are missing, or do not fit.
        """
        self._path = path or shipped(self.name)
        self._fitted = read_fitted(self._path, self.name)
        self.min_similarity, self.trained_on = self._fitted.min_similarity, self._fitted.trained_on
        self.fingerprint = self._fitted.fingerprint

    @property
    def certificate(self) -> Certificate | None:
        """What min_similarity was calibrated on, where a certificate lies beside the file.

        Raises:
            RecognizerError: it cannot be read.
        """
        return certificate_beside(self._path) if self._path else None


def shipped(recognizer: str) -> Path:
    """Return the file of a built-in recognizer that comes with the package."""
    return Path(__file__).parents[1] / "weights" / f"{recognizer}{WEIGHTS_SUFFIX}"


def write_fitted(path: Path, recognizer: str, fitted: Fitted) -> None:
    """Write what a recognizer, known by its installed name, learned; the same, the same bytes.

    Raises:
        RecognizerError: a file cannot hold it, it has values that are not finite, or the file
            cannot be written.
    """
    content = {name: np.ascontiguousarray(array) for name, array in fitted.arrays.items()}
    for name, array in content.items():
        if not np.isfinite(array).all():
            raise RecognizerError(
                f"what {recognizer} learned has values in {name!r} that are NaN or infinite; "
                f"give more images, or others: {path}"
            )
    try:
        description = _Description(
            recognizer=recognizer,
            min_similarity=fitted.min_similarity,
            trained_on=fitted.trained_on,
            facts=dict(sorted(fitted.facts.items())),
        )
    except ValidationError as error:
        first = error.errors()[0]
        what = ".".join(map(str, first["loc"]))
        raise RecognizerError(
            f"{what} = {first['input']!r} cannot be kept in a file: {first['msg']}: {path}"
        ) from error
    write_atomically(path, save(content, {METADATA_KEY: description.model_dump_json()}))


def read_fitted(path: Path, recognizer: str) -> Fitted:
    """Return what a recognizer learned.

    Raises:
        RecognizerError: the file cannot be read, or is not of this recognizer.
    """
    remedy = f"`placerec fit {recognizer} FOLDER --out FILE` makes one"
    if not is_file(path):
        raise RecognizerError(f"there is no file of what {recognizer} learned; {remedy}: {path}")
    check_file(path, MOST_WEIGHTS_BYTES, kind=RecognizerError)
    try:
        with safe_open(path, framework="np") as file:
            description = _Description.model_validate_json((file.metadata() or {})[METADATA_KEY])
            arrays = {name: file.get_tensor(name) for name in list(file.keys())}
        # Other libraries may have taught numpy more kinds of numbers, as onnx does.
        if any(each.dtype.kind not in "biuf" for each in arrays.values()):
            raise TypeError("numbers of a kind that numpy itself lacks")
    except (OSError, SafetensorError, KeyError, TypeError, ValidationError) as error:
        raise RecognizerError(f"not a whole file of {recognizer}; {remedy}: {path}") from error
    if (owner := description.recognizer) != recognizer:
        raise RecognizerError(f"the file is of {owner}, not of {recognizer}: {path}")
    return Fitted(arrays, description.facts, description.trained_on, description.min_similarity)


def owner_of(path: Path) -> str | None:
    """Return the recognizer whose file it is, None where it is of another kind or damaged."""
    if not is_file(path):
        return None
    try:
        with safe_open(path, framework="np") as file:
            return _Description.model_validate_json(file.metadata()[METADATA_KEY]).recognizer
    except (OSError, SafetensorError, KeyError, TypeError, ValidationError):
        return None


def open_recognizer(path: Path) -> PlaceRecognizer:
    """Return the recognizer whose file it is: a trained network, or one with what it learned.

    Raises:
        RecognizerError: the file cannot be read, its recognizer is not installed or cannot be
            imported, or cannot be constructed with it.
    """
    owner = owner_of(path)
    network = EntryPoint(name=str(path), value=_NETWORK_READER, group=ENTRY_POINT_GROUP)
    reader = imported(network if owner is None else find(owner), f"the recognizer of {path.name}")
    try:
        return cast(Callable[[Path], PlaceRecognizer], reader)(path)
    except RecognizerError:
        raise
    except Exception as error:
        raise RecognizerError(
            f"the file says it is of {owner}, and does not fit: {cause_of(error)}: {path}"
        ) from error


def keep_calibration(path: Path, recognizer: str, certificate: Certificate) -> Path:
    """Give a file the threshold that it was calibrated to, and return the certificate's path.

    Raises:
        RecognizerError: one of the files cannot be read or written.
    """
    fitted, beside = read_fitted(path, recognizer), certificate_path(path)
    write_certificate(certificate, beside)
    write_fitted(path, recognizer, replace(fitted, min_similarity=certificate.min_similarity))
    return beside

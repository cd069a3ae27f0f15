# SPDX-License-Identifier: Apache-2.0
"""The one interface between a way of recognising places and everything that uses it."""

import re
from collections.abc import Callable
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import NoReturn, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

ENTRY_POINT_GROUP = "placerec.recognizers"
WEIGHTS_SUFFIX = ".safetensors"
WEIGHTS_READER = "placerec.fitted_file:open_recognizer"
"""Found when it is needed, as every recognizer: reading weights may take torch."""
MAX_LENGTH_ERROR = 1e-3


class RecognizerError(Exception):
    """A recognizer that cannot be found or misbehaves: one line that says what and whose."""


@runtime_checkable
class PlaceRecognizer(Protocol):
    """Turns an image into a point on the unit sphere; near points are the same place.

    It may also have a `certificate`, what min_similarity was calibrated on, and a `fingerprint`
    that tells its versions apart: see `placerec.certificate`.

    Attributes:
        min_similarity: cosine from which a match is worth verifying, calibrated for this method;
            not one from which it is surely right, for geometry has the last word.
    """

    min_similarity: float

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image."""
        ...


def available() -> tuple[str, ...]:
    """Return the sorted names of the installed recognizers; none of them is imported."""
    return tuple(sorted(entry_points(group=ENTRY_POINT_GROUP).names))


def load(name: str) -> PlaceRecognizer:
    """Return a new recognizer by its installed name, `package.module:ClassName` or weights file.

    Only the named one is imported. What is named is a class or a function without arguments, or
    the path of what `placerec train` or `placerec fit` wrote, which ends in .safetensors.

    Raises:
        RecognizerError: there is none of that name, two packages claim it, it cannot be imported
            or constructed, what it makes is not a recognizer, or the weights cannot be used.
    """
    if name.endswith(WEIGHTS_SUFFIX):
        reader = EntryPoint(name=name, value=WEIGHTS_READER, group=ENTRY_POINT_GROUP).load()
        return cast(PlaceRecognizer, reader(Path(name)))
    entry = find(name)
    title = _title(name, entry)
    try:
        make = entry.load()
    except Exception as error:
        raise RecognizerError(f"{title} cannot be imported: {_cause(error)}") from error
    if not callable(make):
        raise RecognizerError(f"{title} is a {type(make).__name__}; name a class or a function")
    try:
        recognizer = cast(Callable[[], object], make)()
    except Exception as error:
        raise RecognizerError(f"{title} cannot be constructed: {_cause(error)}") from error
    return _with_members(recognizer, title)


def find(name: str) -> EntryPoint:
    """Return where the recognizer of an installed name or `package.module:ClassName` is.

    Raises:
        RecognizerError: there is none of that name, or two packages claim it.
    """
    if ":" in name:
        if not re.fullmatch(r"[\w.]+:[\w.]+", name):
            raise RecognizerError(f"recognizer {name!r} is not like package.module:ClassName")
        return EntryPoint(name=name, value=name, group=ENTRY_POINT_GROUP)
    found = list(entry_points(group=ENTRY_POINT_GROUP, name=name))
    if not found:
        raise RecognizerError(_unknown(name))
    if len(found) > 1:
        owners = " and ".join(sorted(entry.dist.name if entry.dist else "?" for entry in found))
        raise RecognizerError(f"recognizer {name!r} is claimed by {owners}; uninstall all but one")
    return found[0]


class CheckedRecognizer:
    """A recognizer whose every answer is checked, so that its callers need not doubt it.

    Attributes:
        min_similarity: cosine from which a match is worth verifying, finite, -1 to 1.
    """

    min_similarity: float

    def __init__(self, recognizer: PlaceRecognizer, name: str | None = None) -> None:
        """Wrap a recognizer; the name is what errors call it, by default its class's.

        Raises:
            RecognizerError: a member is missing or min_similarity is not a cosine.
        """
        self._title = f"recognizer {name or type(recognizer).__name__!r}"
        self._recognizer = _with_members(recognizer, self._title)
        self._dimension: int | None = None
        self.min_similarity = self._checked_threshold(recognizer.min_similarity)

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image.

        Raises:
            RecognizerError: the recognizer failed, or its answer is not a finite vector of unit
                length with as many values as before.
        """
        try:
            answer = self._recognizer.embed(image)
        except Exception as error:
            raise RecognizerError(f"{self._title} failed: {_cause(error)}") from error
        return self._unit_vector(self._vector(answer))

    def _vector(self, answer: object) -> NDArray[np.float64]:
        try:
            vector = np.asarray(answer, dtype=np.float64)
        except Exception as error:
            self._refuse(f"a {type(answer).__name__} that is not an array of numbers", error)
        if vector.ndim != 1 or vector.size == 0:
            self._refuse(f"an array of shape {vector.shape}; embed must return shape (D,)")
        if not np.isfinite(vector).all():
            count = np.count_nonzero(~np.isfinite(vector))
            self._refuse(f"{count} of {vector.size} values that are NaN or infinite")
        if self._dimension not in (None, vector.size):
            self._refuse(f"{vector.size} values after {self._dimension} for earlier images")
        self._dimension = vector.size
        return vector

    def _unit_vector(self, vector: NDArray[np.float64]) -> NDArray[np.float32]:
        length = float(np.linalg.norm(vector))
        if not abs(length - 1.0) <= MAX_LENGTH_ERROR:
            self._refuse(f"a vector of length {length:.6g}; divide it by its length")
        return (vector / length).astype(np.float32)

    def _checked_threshold(self, value: object) -> float:
        try:
            threshold = float(cast(float, value))
        except (TypeError, ValueError):
            threshold = np.nan
        if not -1.0 <= threshold <= 1.0:
            raise RecognizerError(
                f"{self._title} has min_similarity = {value!r}; it must be a cosine, -1 to 1"
            )
        return threshold

    def _refuse(self, what: str, cause: Exception | None = None) -> NoReturn:
        raise RecognizerError(f"{self._title} returned {what}") from cause


def _unknown(name: str) -> str:
    names = available()
    close = get_close_matches(name, names, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    listed = ", ".join(names) or "none"
    return (
        f"there is no recognizer {name!r}{hint}; installed: {listed}; "
        "or name a class as package.module:ClassName, or a file of weights, *.safetensors"
    )


def _title(name: str, entry: EntryPoint) -> str:
    return f"recognizer {name!r}" if name == entry.value else f"recognizer {name!r} ({entry.value})"


def _with_members(recognizer: object, title: str) -> PlaceRecognizer:
    if not callable(getattr(recognizer, "embed", None)):
        raise RecognizerError(f"{title} has no method embed(image)")
    if not hasattr(recognizer, "min_similarity"):
        raise RecognizerError(f"{title} has no attribute min_similarity")
    return cast(PlaceRecognizer, recognizer)


def _cause(error: Exception) -> str:
    """Return an exception as one line."""
    text = " ".join(str(error).split())
    if isinstance(error, RecognizerError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__

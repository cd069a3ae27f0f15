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

from placerec.comparison import COSINES, Comparer, Embeddings, Similarities, flaw_in

ENTRY_POINT_GROUP = "placerec.recognizers"
WEIGHTS_SUFFIX = ".safetensors"
WEIGHTS_READER = "placerec.fitted_file:open_recognizer"
"""Found when it is needed, as every recognizer: reading weights may take torch."""
MAX_LENGTH_ERROR = 1e-3
LOOKS_BACK = 32


class RecognizerError(Exception):
    """A recognizer that cannot be found or misbehaves: one line that says what and whose."""


@runtime_checkable
class PlaceRecognizer(Protocol):
    """Turns an image into a point on the unit sphere; near points are the same place.

    It may also have a `certificate`, what min_similarity was calibrated on, and a `fingerprint`
    that tells its versions apart: see `placerec.certificate`.

    A method that compares by something other than one dot product has a method
    `compare(queries, references)`. It takes (Q, *S) and (R, *S) float32 embeddings, each in the
    order in which they were seen, leaves them as they are, and returns (Q, R) float32 similarities
    from -1 to 1: larger is more alike. `embed` may then return a finite array of any shape S,
    always the same. While a map is made, the queries are the latest embeddings and the last row of
    the answer is used: the 32 before it come along for methods that compare sequences, or as many
    as `looks_back: int` says, which makes comparing faster where it is 0.

    Attributes:
        min_similarity: similarity from which a match is worth verifying, calibrated for this one;
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
    make = imported(entry, title)
    if not callable(make):
        raise RecognizerError(f"{title} is a {type(make).__name__}; name a class or a function")
    try:
        recognizer = cast(Callable[[], object], make)()
    except Exception as error:
        raise RecognizerError(f"{title} cannot be constructed: {cause_of(error)}") from error
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


def imported(entry: EntryPoint, title: str) -> object:
    """Return what an entry point names; the title is what errors call it.

    Raises:
        RecognizerError: it cannot be imported.
    """
    try:
        return cast(object, entry.load())
    except Exception as error:
        raise RecognizerError(f"{title} cannot be imported: {cause_of(error)}") from error


def cause_of(error: Exception) -> str:
    """Return an exception as one line."""
    text = " ".join(str(error).split())
    if isinstance(error, RecognizerError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class CheckedRecognizer:
    """A recognizer whose every answer is checked, so that its callers need not doubt it.

    It always has `compare`: by cosine, unless the recognizer has its own.

    Attributes:
        min_similarity: similarity from which a match is worth verifying, finite, -1 to 1.
        looks_back: how many queries before the one in question matter to its similarities.
    """

    min_similarity: float
    looks_back: int

    def __init__(self, recognizer: PlaceRecognizer, name: str | None = None) -> None:
        """Wrap a recognizer; the name is what errors call it, by default its class's.

        Raises:
            RecognizerError: a member is missing or is not what it must be.
        """
        self._title = f"recognizer {name or type(recognizer).__name__!r}"
        self._recognizer = _with_members(recognizer, self._title)
        self._comparer = self._own_comparer() or COSINES
        self._shape: tuple[int, ...] | None = None
        self.min_similarity = self._checked_threshold(recognizer.min_similarity)
        self.looks_back = self._checked_looks_back()

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the float32 embedding of a (H, W, 3) uint8 RGB image.

        It is (D,) and of unit length; of another shape only if the recognizer compares its own.

        Raises:
            RecognizerError: the recognizer failed, or its answer is not finite, not of the shape
                as before, or not the unit vector that it must be.
        """
        try:
            answer = self._recognizer.embed(image)
        except Exception as error:
            raise RecognizerError(f"{self._title} failed: {cause_of(error)}") from error
        values = self._array(answer)
        return self._unit_vector(values) if self._comparer is COSINES else values.astype(np.float32)

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return the (Q, R) float32 similarities, -1 to 1, of (Q, *S) and (R, *S) embeddings.

        Both are in the order in which they were seen.

        Raises:
            RecognizerError: the recognizer failed, or its answer is no such similarities.
        """
        try:
            answer = self._comparer.compare(queries, references)
        except Exception as error:
            raise RecognizerError(f"{self._title} failed to compare: {cause_of(error)}") from error
        if flaw := flaw_in(answer, (len(queries), len(references))):
            self._refuse(flaw)
        return np.clip(np.asarray(answer, np.float32), -1.0, 1.0)

    def _array(self, answer: object) -> NDArray[np.float64]:
        try:
            values = np.asarray(answer, dtype=np.float64)
        except Exception as error:
            self._refuse(f"a {type(answer).__name__} that is not an array of numbers", error)
        if values.size == 0 or values.ndim == 0 or (values.ndim > 1 and self._comparer is COSINES):
            self._refuse(f"an array of shape {values.shape}; embed must return shape (D,)")
        if not np.isfinite(values).all():
            count = np.count_nonzero(~np.isfinite(values))
            self._refuse(f"{count} of {values.size} values that are NaN or infinite")
        if self._shape not in (None, values.shape):
            self._refuse(f"an array of shape {values.shape} after {self._shape} for earlier images")
        self._shape = values.shape
        return values

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
                f"{self._title} has min_similarity = {value!r}; it must lie from -1 to 1"
            )
        return threshold

    def _own_comparer(self) -> Comparer | None:
        own = getattr(self._recognizer, "compare", None)
        if own is not None and not callable(own):
            raise RecognizerError(f"{self._title} has a compare that is no method")
        return None if own is None else cast(Comparer, self._recognizer)

    def _checked_looks_back(self) -> int:
        count: object = getattr(self._comparer, "looks_back", LOOKS_BACK)
        if not isinstance(count, int) or count < 0:
            raise RecognizerError(f"{self._title} has looks_back = {count!r}; it must be 0 or more")
        return count

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

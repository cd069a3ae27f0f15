# SPDX-License-Identifier: Apache-2.0
"""The one interface between a way of recognising places and everything that uses it."""

import re
from collections.abc import Callable
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from placerec.errors import RecognizerError, cause_of

ENTRY_POINT_GROUP = "placerec.recognizers"
WEIGHTS_SUFFIX, ONNX_SUFFIX = ".safetensors", ".onnx"
_READERS = {
    WEIGHTS_SUFFIX: "placerec.recognizers.fitted_file:open_recognizer",
    ONNX_SUFFIX: "placerec.recognizers.onnx_file:OnnxRecognizer",
}
"""By how a file's name ends; found when needed, as every recognizer: weights may take torch."""


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

    One that takes several images at once for less has a method `embed_many(images)`, which returns
    the embeddings of a sequence of such images as `embed` does. It is asked where networks are not
    run on the CPU, of 2 to 32 images.

    A method that can tell more of the few most similar images than their embeddings do has a method
    `rerank(query, candidates)`. It takes a (H, W, 3) uint8 RGB image and a sequence of such, and
    returns (C,) scores from 0, nothing in common, to 1. While a map is made it is asked where a
    second look is wanted, of images at half size; what scores 0 is not verified.

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
    """Return a new recognizer by its installed name, `package.module:ClassName` or file.

    Only the named one is imported. What is named is a class or a function without arguments, or
    the path of what `placerec train` or `placerec fit` wrote, which ends in .safetensors, or of any
    network that makes a vector of an image, which ends in .onnx.

    Raises:
        RecognizerError: there is none of that name, two packages claim it, it cannot be imported
            or constructed, what it makes is not a recognizer, or the file cannot be used.
    """
    for suffix, value in _READERS.items():
        if name.endswith(suffix):
            reader = EntryPoint(name=name, value=value, group=ENTRY_POINT_GROUP).load()
            return cast(PlaceRecognizer, reader(Path(name)))
    entry = find(name)
    title = f"recognizer {name!r}" + ("" if name == entry.value else f" ({entry.value})")
    make = imported(entry, title)
    if not callable(make):
        raise RecognizerError(f"{title} is a {type(make).__name__}; name a class or a function")
    try:
        recognizer = cast(Callable[[], object], make)()
    except (Exception, SystemExit) as error:
        raise RecognizerError(f"{title} cannot be constructed: {cause_of(error)}") from error
    return with_members(recognizer, title)


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
        installed = ", ".join(available()) or "none"
        close = get_close_matches(name, available(), n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise RecognizerError(
            f"there is no recognizer {name!r}{hint}; installed: {installed}; "
            "or name a class as package.module:ClassName, or a file, *.safetensors or *.onnx"
        )
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
    except (Exception, SystemExit) as error:
        raise RecognizerError(f"{title} cannot be imported: {cause_of(error)}") from error


def with_members(recognizer: object, title: str) -> PlaceRecognizer:
    """Return what has the members of the protocol; the title is what errors call it.

    Raises:
        RecognizerError: one is missing.
    """
    try:
        has_embed = callable(getattr(recognizer, "embed", None))
        has_min_similarity = hasattr(recognizer, "min_similarity")
    except Exception as error:  # a property of somebody else's
        raise RecognizerError(f"{title} does not tell its members: {cause_of(error)}") from error
    if not has_embed:
        raise RecognizerError(f"{title} has no method embed(image)")
    if not has_min_similarity:
        raise RecognizerError(f"{title} has no attribute min_similarity")
    return cast(PlaceRecognizer, recognizer)

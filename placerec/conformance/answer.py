# SPDX-License-Identifier: Apache-2.0
"""Checks of what a recognizer returns."""

from collections.abc import Sequence

import numpy as np

from placerec.checked_recognizer import MAX_LENGTH_ERROR, CheckedRecognizer
from placerec.conformance.made_images import Image, places
from placerec.conformance.subject import Outcome, Subject, Verdict, as_check
from placerec.errors import RecognizerError


@as_check(
    "returns numbers",
    "embed(image) takes a (480, 640, 3) uint8 RGB array and returns a (D,) float32 array",
)
def returns_numbers(subject: Subject) -> Outcome:
    """It returns values."""
    answer: object = subject.recognizer.embed(places()[0])
    values = np.asarray(answer)
    if not np.issubdtype(values.dtype, np.number):  # None would be a NaN
        return False, f"a {type(answer).__name__}, which is not an array of numbers"
    return values.size > 0, f"{values.size} of them"


@as_check(
    "its other members",
    "see placerec.recognizer.PlaceRecognizer; `placerec calibrate` finds min_similarity",
)
def other_members(subject: Subject) -> Outcome:
    """Whatever else the protocol names is what it must be."""
    try:
        checked = CheckedRecognizer(subject.recognizer)
    except RecognizerError as error:
        return False, f"{error}"
    looks_back = f"by itself, looking back {checked.looks_back}"
    how = looks_back if subject.compares else "by cosine"
    return True, f"compares {how}, min_similarity {checked.min_similarity:.4g}"


@as_check(
    "one shape",
    "return (D,) for every image: embedding[0] of a batch of one, embedding.ravel() of a map",
    returns_numbers,
)
def one_shape(subject: Subject) -> Outcome:
    """Embeddings are vectors of one length, or arrays that it compares itself."""
    shapes = sorted({embedding.shape for embedding in subject.embeddings})
    is_fixed = len(shapes) == 1 and len(shapes[0]) > 0
    is_good = is_fixed and (len(shapes[0]) == 1 or subject.compares)
    return is_good, " and ".join(map(str, shapes))


@as_check("float32", "return np.asarray(embedding, np.float32)", returns_numbers)
def _float32(subject: Subject) -> Outcome:
    answer: object = subject.recognizer.embed(places()[0])
    seen = str(answer.dtype) if isinstance(answer, np.ndarray) else f"a {type(answer).__name__}"
    return seen == "float32", seen


@as_check(
    "finite",
    "look for x / 0, a root or logarithm of what is not above 0, float16 beyond 65504",
    returns_numbers,
)
def finite(subject: Subject) -> Outcome:
    """No value is NaN or infinite."""
    is_finite = np.isfinite(np.concatenate([embedding.ravel() for embedding in subject.embeddings]))
    bad = int((~is_finite).sum())
    return bad == 0, f"{bad} of {is_finite.size} values are NaN or infinite"


@as_check(
    "unit length",
    "return v / np.linalg.norm(v); if v may be all 0, first v = np.append(v, 1e-3)",
    one_shape,
    finite,
)
def unit_length(subject: Subject) -> Outcome:
    """Embeddings lie on the unit sphere, unless it compares them itself."""
    if subject.compares:
        return Verdict.NOT_TRIED, "not needed: it compares embeddings by itself"
    lengths = [float(np.linalg.norm(embedding)) for embedding in subject.embeddings]
    good = np.allclose(lengths, 1.0, rtol=0.0, atol=MAX_LENGTH_ERROR)
    return good, f"lengths {min(lengths):.6g} to {max(lengths):.6g}"


@as_check(
    "grey and empty images",
    "append 1e-3 to v, then v / norm(v): plain images are (0, ..., 0, 1); add 1e-6 to a std",
    unit_length,
)
def colourless(subject: Subject) -> Outcome:
    """Images without colour or content have an embedding too."""
    grey = places()[0].mean(axis=2, keepdims=True).astype(np.uint8).repeat(3, axis=2)
    plain = [np.full_like(grey, colour) for colour in (0, 255, (200, 40, 90))]
    return _like_the_others(subject, ("grey", "black", "white", "one hue"), [grey, *plain])


@as_check(
    "images of any size",
    "resize within embed: callers hand images over as they come from the camera",
    unit_length,
)
def any_size(subject: Subject) -> Outcome:
    """Images of any size have embeddings of one shape."""
    wall = places()[0]
    cut = [wall[:241, :319], wall[:97, :641], wall[:480, :161], wall.repeat(2, 0).repeat(2, 1)]
    images = [np.ascontiguousarray(image) for image in cut]
    return _like_the_others(subject, [f"{i.shape[1]}x{i.shape[0]}" for i in images], images)


def _like_the_others(subject: Subject, titles: Sequence[str], images: list[Image]) -> Outcome:
    usual = subject.embeddings[0].shape
    for title, image in zip(titles, images, strict=True):
        try:
            embedding = subject.embed(image)
        except Exception as error:
            return False, f"{title}: {subject.explain(error)}"
        if embedding.shape != usual:
            return False, f"{title}: shape {embedding.shape}, of others {usual}"
        if not np.isfinite(embedding).all():
            return False, f"{title}: values that are NaN or infinite"
        length = float(np.linalg.norm(embedding))
        if not (subject.compares or abs(length - 1.0) <= MAX_LENGTH_ERROR):
            return False, f"{title}: a vector of length {length:.6g}"
    return True, f"{', '.join(titles)}: all {usual}"


CHECKS = (
    returns_numbers,
    other_members,
    one_shape,
    _float32,
    finite,
    unit_length,
    colourless,
    any_size,
)

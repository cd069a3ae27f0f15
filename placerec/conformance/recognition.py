# SPDX-License-Identifier: Apache-2.0
"""Checks that a place is known again, by all that its image shows."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.conformance.answer import any_size
from placerec.conformance.comparison import each_on_its_own, one_by_one
from placerec.conformance.made_images import PLACES, SHIFT_PX, halved, places
from placerec.conformance.subject import Outcome, Subject, as_check

_TIE = 1e-6
"""Places less apart than this are one to the recognizer, and none of them is found."""
_PARTS = 3
_UNSEEN = 0.05
"""Of the largest change of an embedding: where it changes less, nothing was looked at."""
_LEAST_HALVED = PLACES // 2


@as_check(
    "an image itself",
    "different pictures must differ; pixels are 0 to 255; a distance d is the similarity 1 - d",
    one_by_one,
    each_on_its_own,
)
def itself(subject: Subject) -> Outcome:
    """Each place is more like itself than like another."""
    found = _find(subject, [np.stack(subject.embeddings)])
    return found.right == found.count, str(found)


@as_check(
    "darker and brighter",
    "subtract the mean, divide by the deviation, or look at gradients rather than at values",
    itself,
)
def relit(subject: Subject) -> Outcome:
    """A place is known in less light and in more."""
    found = _find(subject, subject.relit)
    return found.right == found.count, str(found)


@as_check(
    f"shifted by {SHIFT_PX} pixels",
    "let neighbours count together: blur, or pool over regions, before comparing",
    itself,
)
def shifted(subject: Subject) -> Outcome:
    """A place is known where the camera turned a little."""
    found = _find(subject, subject.shifted)
    return found.right == found.count, str(found)


@as_check(
    "at half the size",
    "resize every image to one size first, such as cv2.resize(image, (320, 240))",
    any_size,
    relit,
    shifted,
)
def _halved(subject: Subject) -> Outcome:
    found = _find(subject, [np.stack([subject.embed(image) for image in halved()])])
    return found.right >= _LEAST_HALVED, f"{found}; {_LEAST_HALVED} have to be"


@as_check(
    "sees all of the image",
    "crop by image.shape[:2], if at all; divide pixels by 255 before clipping them to 1",
    itself,
)
def _sees_all(subject: Subject) -> Outcome:
    """Neither width nor height are seen in part only, where parts of another place are put."""
    place, other = places()[:2]
    changes = np.zeros((_PARTS, _PARTS))
    rows, columns = (np.linspace(0, side, _PARTS + 1).astype(int) for side in place.shape[:2])
    for row, column in np.ndindex(changes.shape):
        part = np.s_[rows[row] : rows[row + 1], columns[column] : columns[column + 1]]
        changed = place.copy()
        changed[part] = other[part]
        gap = subject.embed(changed).astype(np.float64) - subject.embeddings[0]
        changes[row, column] = np.linalg.norm(gap)
    is_seen = changes > _UNSEEN * changes.max()
    # A strip, without the sky or the bonnet, is still seen over its whole length.
    spans = is_seen.any(axis=1).all() or is_seen.any(axis=0).all()
    return bool(spans), f"{is_seen.sum()} of {is_seen.size} parts change its embedding"


@dataclass(frozen=True)
class _Found:
    """How many views of places were more like their own place than like any other."""

    right: int
    count: int
    own: float
    others: float

    def __str__(self) -> str:
        return (
            f"{self.right} of {self.count} found; similarity at least {self.own:.3f}, "
            f"to others at most {self.others:.3f}"
        )


def _find(subject: Subject, rounds: list[NDArray[Any]]) -> _Found:
    """Look for views of all places, seen in the order in which the places were."""
    references = np.stack(subject.embeddings)
    values = np.concatenate(
        [np.asarray(subject.comparer.compare(queries, references)) for queries in rounds]
    )
    is_own = np.tile(np.eye(PLACES, dtype=np.bool_), (len(rounds), 1))
    own, others = values[is_own], np.where(is_own, -np.inf, values).max(axis=1)
    right = int((own > others + _TIE).sum())
    return _Found(right, len(own), float(own.min()), float(others.max()))


CHECKS = (itself, relit, shifted, _halved, _sees_all)

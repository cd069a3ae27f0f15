# SPDX-License-Identifier: Apache-2.0
"""Checks that embeddings can be compared, and that a place is known again."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import CheckedRecognizer, flaw_in
from placerec.conformance.answer import LENGTH, MEMBERS
from placerec.conformance.made_images import (
    BRIGHTER,
    DARKER,
    PLACES,
    SHIFT_PX,
    Image,
    places,
    relit,
)
from placerec.conformance.subject import Check, Outcome, Subject, judged, not_tried

SIMILARITIES = "similarities from -1 to 1"
ALONE = "leaves embeddings alone"
ITSELF = "an image itself"
TIE = 1e-6
"""Places less apart than this are one to the recognizer, and none of them is found."""
ROUNDING = 1e-5
"""Similarities may differ by as much, for sums are taken in another order."""


def _similarities(subject: Subject) -> Outcome:
    embeddings = np.stack(subject.embeddings)
    # Fewer queries than references: whoever takes the one for the other is found out.
    queries = embeddings[1:].copy()
    answer: object = subject.comparer.compare(queries, embeddings)
    flaw = flaw_in(answer, (len(queries), len(embeddings)))
    if flaw:
        return judged(False, flaw)
    values = np.asarray(answer)
    return judged(True, f"{values.size} of them, {values.min():.3f} to {values.max():.3f}")


def _leaves_embeddings(subject: Subject) -> Outcome:
    references = np.stack(subject.embeddings)
    queries = references[1:].copy()
    subject.comparer.compare(queries, references)
    before = np.stack(subject.embeddings)
    changed = int((references != before).sum() + (queries != before[1:]).sum())
    return judged(changed == 0, f"{changed} values changed")


def _one_by_one(subject: Subject) -> Outcome:
    looks_back = CheckedRecognizer(subject.recognizer).looks_back
    if looks_back >= PLACES - 1:
        return not_tried(f"it looks back {looks_back}, over all {PLACES} pictures")
    embeddings = np.stack(subject.embeddings)
    together = subject.comparer.compare(embeddings, embeddings)
    alone = [
        subject.comparer.compare(embeddings[max(0, i - looks_back) : i + 1], embeddings)[-1]
        for i in range(PLACES)
    ]
    gap = float(np.abs(together - np.stack(alone)).max())
    return judged(gap <= ROUNDING, f"largest difference {gap:.2g}")


def _itself(subject: Subject) -> Outcome:
    return _found(subject, places())


def _relit(subject: Subject) -> Outcome:
    return _found(subject, relit(places(), DARKER), relit(places(), BRIGHTER))


def _shifted(subject: Subject) -> Outcome:
    return _found(subject, places(SHIFT_PX))


def _found(subject: Subject, *rounds: list[Image]) -> Outcome:
    """Look for views of all places, seen in the order in which the places were."""
    similarities = np.concatenate([_compared(subject, views) for views in rounds])
    is_own = np.tile(np.eye(PLACES, dtype=np.bool_), (len(rounds), 1))
    own, others = similarities[is_own], np.where(is_own, -np.inf, similarities).max(axis=1)
    right = int((own > others + TIE).sum())
    return judged(
        right == len(own),
        f"{right} of {len(own)} found; similarity at least {own.min():.3f}, "
        f"to others at most {others.max():.3f}",
    )


def _compared(subject: Subject, views: list[Image]) -> NDArray[Any]:
    queries = np.stack([subject.embed(view) for view in views])
    return np.asarray(subject.comparer.compare(queries, np.stack(subject.embeddings)))


CHECKS = (
    Check(
        SIMILARITIES,
        _similarities,
        "compare(queries, references) returns (Q, R): more alike is larger, 1 is the most",
        needs=(LENGTH,),
    ),
    Check(
        ALONE,
        _leaves_embeddings,
        "they are the map's own: subtract into a new array, or work on references.copy()",
        needs=(SIMILARITIES,),
    ),
    Check(
        "queries one at a time",
        _one_by_one,
        "let looks_back say how many queries before the last matter to its similarities",
        needs=(ALONE, MEMBERS),
    ),
    Check(
        ITSELF,
        _itself,
        "different pictures must differ in their embeddings, and by more than rounding",
        needs=(ALONE,),
    ),
    Check(
        "darker and brighter",
        _relit,
        "subtract the mean, divide by the deviation, or look at gradients rather than at values",
        needs=(ITSELF,),
    ),
    Check(
        f"shifted by {SHIFT_PX} pixels",
        _shifted,
        "let neighbours count together: blur, or pool over regions, before comparing",
        needs=(ITSELF,),
    ),
)

# SPDX-License-Identifier: Apache-2.0
"""Checks that embeddings can be compared, and that a place is known again."""

import numpy as np

from placerec.checked_recognizer import CheckedRecognizer, flaw_in
from placerec.conformance.answer import other_members, unit_length
from placerec.conformance.made_images import PLACES, SHIFT_PX, Image, places
from placerec.conformance.subject import Outcome, Subject, as_check

_GAINS = (0.8, 1.25)
_TIE = 1e-6
"""Places less apart than this are one to the recognizer, and none of them is found."""
_ROUNDING = 1e-5
"""Similarities may differ by as much, for sums are taken in another order."""


@as_check(
    "similarities from -1 to 1",
    "compare(queries, references) returns (Q, R): more alike is larger, 1 is the most",
    unit_length,
)
def similarities(subject: Subject) -> Outcome:
    """Embeddings can be compared."""
    embeddings = np.stack(subject.embeddings)
    # Fewer queries than references: whoever takes the one for the other is found out.
    queries = embeddings[1:].copy()
    answer: object = subject.comparer.compare(queries, embeddings)
    flaw = flaw_in(answer, (len(queries), len(embeddings)))
    if flaw:
        return False, flaw
    values = np.asarray(answer)
    return True, f"{values.size} of them, {values.min():.3f} to {values.max():.3f}"


@as_check(
    "leaves embeddings alone",
    "they are the map's own: subtract into a new array, or work on references.copy()",
    similarities,
)
def _leaves_embeddings(subject: Subject) -> Outcome:
    references = np.stack(subject.embeddings)
    queries = references[1:].copy()
    subject.comparer.compare(queries, references)
    before = np.stack(subject.embeddings)
    changed = int((references != before).sum() + (queries != before[1:]).sum())
    return changed == 0, f"{changed} values changed"


@as_check(
    "queries one at a time",
    "let looks_back say how many queries before the last matter to its similarities",
    _leaves_embeddings,
    other_members,
)
def _one_by_one(subject: Subject) -> Outcome:
    looks_back = CheckedRecognizer(subject.recognizer).looks_back
    if looks_back >= PLACES - 1:
        return None, f"it looks back {looks_back}, over all {PLACES} pictures"
    embeddings = np.stack(subject.embeddings)
    together = subject.comparer.compare(embeddings, embeddings)
    alone = [
        subject.comparer.compare(embeddings[max(0, i - looks_back) : i + 1], embeddings)[-1]
        for i in range(PLACES)
    ]
    gap = float(np.abs(together - np.stack(alone)).max())
    return gap <= _ROUNDING, f"largest difference {gap:.2g}"


@as_check(
    "an image itself",
    "different pictures must differ in their embeddings, and by more than rounding",
    _leaves_embeddings,
)
def _itself(subject: Subject) -> Outcome:
    return _found(subject, places())


@as_check(
    "darker and brighter",
    "subtract the mean, divide by the deviation, or look at gradients rather than at values",
    _itself,
)
def _relit(subject: Subject) -> Outcome:
    # As a shorter or longer exposure shows them; what is too bright is white.
    lit = [[np.clip(i * gain, 0, 255).astype(np.uint8) for i in places()] for gain in _GAINS]
    return _found(subject, *lit)


@as_check(
    f"shifted by {SHIFT_PX} pixels",
    "let neighbours count together: blur, or pool over regions, before comparing",
    _itself,
)
def _shifted(subject: Subject) -> Outcome:
    return _found(subject, places(SHIFT_PX))


def _found(subject: Subject, *rounds: list[Image]) -> Outcome:
    """Look for views of all places, seen in the order in which the places were."""
    references = np.stack(subject.embeddings)
    embedded = [np.stack([subject.embed(view) for view in views]) for views in rounds]
    found = [np.asarray(subject.comparer.compare(queries, references)) for queries in embedded]
    values = np.concatenate(found)
    is_own = np.tile(np.eye(PLACES, dtype=np.bool_), (len(rounds), 1))
    own, others = values[is_own], np.where(is_own, -np.inf, values).max(axis=1)
    right = int((own > others + _TIE).sum())
    return (
        right == len(own),
        f"{right} of {len(own)} found; similarity at least {own.min():.3f}, "
        f"to others at most {others.max():.3f}",
    )


CHECKS = (similarities, _leaves_embeddings, _one_by_one, _itself, _relit, _shifted)

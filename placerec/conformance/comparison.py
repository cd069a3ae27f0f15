# SPDX-License-Identifier: Apache-2.0
"""Checks that embeddings can be compared, and that each pair is compared on its own."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import CheckedRecognizer, flaw_in
from placerec.conformance.answer import colourless, other_members, unit_length
from placerec.conformance.repetition import much_later
from placerec.conformance.side_effects import gives_away
from placerec.conformance.subject import Outcome, Subject, Verdict, as_check

_ROUNDING = 1e-5
"""Similarities may differ by as much, for sums are taken in another order."""
_MANY = 48
"""References; methods that compare sequences may look at some beside the one in question."""
_LAST = 3
_MOST_BACK = 500
_SAME = 1e-3
_ALL_ALIKE = 0.98


@as_check(
    "similarities from -1 to 1",
    "compare returns (Q, R): more alike is larger, 1 the most; divide by max(norm(v), 1e-9)",
    unit_length,
    colourless,
    gives_away,
)
def similarities(subject: Subject) -> Outcome:
    """Embeddings can be compared, those of plain images too."""
    embeddings = subject.unlike
    # Fewer queries than references: whoever takes the one for the other is found out. And one of
    # each, as at the second keyframe: whoever squeezes axes of length 1 away is, too.
    found = []
    for count, of in ((len(embeddings) - 1, len(embeddings)), (1, 1), (1, 2)):
        queries, references = embeddings[-count:].copy(), embeddings[-of:].copy()
        answer: object = subject.comparer.compare(queries, references)
        if flaw := flaw_in(answer, (count, of)):
            return False, flaw
        found.append(np.asarray(answer))
    values = found[0]
    return True, f"{values.size} of them, {values.min():.3f} to {values.max():.3f}"


@as_check(
    "leaves embeddings alone",
    "they are the map's own: subtract into a new array, or work on references.copy()",
    similarities,
)
def leaves_embeddings(subject: Subject) -> Outcome:
    """Comparing changes no embedding."""
    references = np.stack(subject.embeddings)
    queries = references[1:].copy()
    subject.comparer.compare(queries, references)
    before = np.stack(subject.embeddings)
    changed = int((references != before).sum() + (queries != before[1:]).sum())
    return changed == 0, f"{changed} values changed"


@as_check(
    "queries one at a time",
    "let looks_back say how many queries before the last matter to its similarities",
    leaves_embeddings,
    other_members,
)
def one_by_one(subject: Subject) -> Outcome:
    """The queries before count for no more than it says."""
    looks_back = CheckedRecognizer(subject.recognizer).looks_back
    if looks_back > _MOST_BACK:
        return Verdict.NOT_TRIED, f"it looks back {looks_back}"
    references = np.stack(subject.embeddings)
    queries = _tiled(references, looks_back + len(references))
    together = subject.comparer.compare(queries, references)[-_LAST:]
    ends = range(len(queries) - _LAST + 1, len(queries) + 1)
    alone = [
        subject.comparer.compare(queries[end - looks_back - 1 : end].copy(), references)[-1]
        for end in ends
    ]
    gap = float(np.abs(together - np.stack(alone)).max())
    return gap <= _ROUNDING, f"largest difference {gap:.2g}"


@as_check(
    "unlike pictures are unlike",
    "before normalising, subtract what all images share, their mean; pixels are 0 to 255",
    similarities,
    much_later,
)
def spread(subject: Subject) -> Outcome:
    """Pictures that have nothing in common are not all alike to it."""
    least = float(unlike_similarities(subject).min())
    return least < _ALL_ALIKE, f"the least alike of them: {least:.4f}, {_ALL_ALIKE} is too much"


@as_check(
    "other references, other answers",
    "keep nothing of what was compared before, such as an index of the references, on self",
    leaves_embeddings,
    spread,
)
def _no_stale_references(subject: Subject) -> Outcome:
    embeddings = np.stack(subject.embeddings)
    before = subject.comparer.compare(embeddings, embeddings)
    turned = subject.comparer.compare(embeddings, embeddings[::-1].copy())
    changed = int((np.asarray(before) != np.asarray(turned)).sum())
    return changed > 0, f"{changed} of {np.size(turned)} change where references are turned round"


@as_check(
    "whichever others are there",
    "compare each pair by itself: no softmax, rank, mean or maximum over the references",
    _no_stale_references,
    other_members,
)
def each_on_its_own(subject: Subject) -> Outcome:
    """The similarity of a pair does not depend on which other references there are."""
    looks_back = CheckedRecognizer(subject.recognizer).looks_back
    if looks_back > _MOST_BACK:
        return Verdict.NOT_TRIED, f"it looks back {looks_back}"
    # Sequences of references may count: so many that those that are added are out of reach.
    count = _MANY + 2 * looks_back
    some, others = np.split(np.stack(subject.embeddings), 2)
    queries = np.stack([some[-1], others[0]])
    few = _tiled(some, count)
    many = np.concatenate([few, _tiled(np.concatenate([others, subject.unlike]), count)])
    # The first ones only, for the same reason.
    alone, among = (
        np.asarray(subject.comparer.compare(queries, references))[:, : len(some)]
        for references in (few, many)
    )
    worst = np.unravel_index(np.abs(alone - among).argmax(), alone.shape)
    says = f"{alone[worst]:.4g} among {len(few)} references, {among[worst]:.4g} among {len(many)}"
    return bool(np.allclose(alone, among, rtol=0.0, atol=_ROUNDING)), says


@as_check(
    "the opposite is unlike",
    "return the cosine as it is: its absolute value or square takes opposites for one place",
    _no_stale_references,
)
def _keeps_sign(subject: Subject) -> Outcome:
    embeddings = np.stack(subject.embeddings)
    own = np.diagonal(subject.comparer.compare(embeddings, embeddings))
    try:
        answer: object = subject.comparer.compare(embeddings, -embeddings)
    except Exception:
        answer = None
    if flaw_in(answer, (len(embeddings), len(embeddings))):  # it may know that no image is like it
        return Verdict.NOT_TRIED, "it does not compare the opposite of an embedding"
    opposite = np.diagonal(np.asarray(answer))
    says = f"to itself {own.min():.3f} or more, to its opposite {opposite.max():.3f} at most"
    return bool((np.abs(own - opposite) > _SAME).any()), says


def unlike_similarities(subject: Subject) -> NDArray[np.float64]:
    """Return the (N,) similarities of pictures that have nothing in common, each pair once."""
    values = np.asarray(subject.comparer.compare(subject.unlike, subject.unlike), np.float64)
    return values[np.tril_indices(len(values), -1)]


def _tiled(embeddings: NDArray[Any], count: int) -> NDArray[Any]:
    """Return so many embeddings, those given over and over."""
    return np.take(embeddings, np.arange(count) % len(embeddings), axis=0)


CHECKS = (
    similarities,
    leaves_embeddings,
    one_by_one,
    spread,
    _no_stale_references,
    each_on_its_own,
    _keeps_sign,
)

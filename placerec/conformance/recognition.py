# SPDX-License-Identifier: Apache-2.0
"""Checks that a place is known again, as it was and a little different."""

import numpy as np

from placerec.conformance.answer import LENGTH
from placerec.conformance.finding import Check, Outcome, judged
from placerec.conformance.pictures import BRIGHTER, DARKER, SHIFT_PX, Image, places, relit
from placerec.conformance.subject import Subject

ITSELF = "an image itself"
TIE = 1e-6
"""Places less apart than this are one to the recognizer, and none of them is found."""


def _itself(subject: Subject) -> Outcome:
    return _found(subject, places())


def _relit(subject: Subject) -> Outcome:
    return _found(subject, [*relit(places(), DARKER), *relit(places(), BRIGHTER)])


def _shifted(subject: Subject) -> Outcome:
    return _found(subject, places(SHIFT_PX))


def _found(subject: Subject, views: list[Image]) -> Outcome:
    """Look for views among the places, which they show in the same order, over and over."""
    queries = [subject.embed(view) for view in views]
    similarities = subject.similarities(queries, subject.embeddings)
    one_round = np.eye(len(subject.embeddings), dtype=np.bool_)
    is_own = np.tile(one_round, (len(views) // len(one_round), 1))
    own, others = similarities[is_own], np.where(is_own, -np.inf, similarities).max(axis=1)
    right = int((own > others + TIE).sum())
    return judged(
        right == len(views),
        f"{right} of {len(views)} found; similarity at least {own.min():.3f}, "
        f"to others at most {others.max():.3f}",
    )


CHECKS = (
    Check(
        ITSELF,
        _itself,
        "different pictures must differ in their embeddings, and by more than rounding",
        needs=(LENGTH,),
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

# SPDX-License-Identifier: Apache-2.0
"""Checks of what was measured against the recognizer's own threshold."""

import numpy as np

from placerec.checked_recognizer import CheckedRecognizer
from placerec.conformance.comparison import unlike_similarities
from placerec.conformance.made_images import PLACES
from placerec.conformance.recognition import itself, relit, shifted
from placerec.conformance.subject import Outcome, Subject, Verdict, as_check

_FEW_REACH = 0.5
_MOST_PASS, _NEARLY_ALL_PASS = 0.7, 0.9
"""Of pictures that have nothing in common; up to 0.5 for those built in."""


@as_check(
    "min_similarity can be reached",
    "min_similarity is too high: take what views of one place reach, or `placerec calibrate`",
    relit,
    shifted,
)
def _reached(subject: Subject) -> Outcome:
    checked = CheckedRecognizer(subject.recognizer)
    references = np.stack(subject.embeddings)
    # A sequence is known again by its end only.
    first = min(checked.looks_back, PLACES - 1)
    own = np.concatenate(
        [
            np.diagonal(subject.comparer.compare(views, references))[first:]
            for views in (*subject.relit, *subject.shifted)
        ]
    )
    reach = int((own >= checked.min_similarity).sum())
    says = (
        f"{reach} of {own.size} reach {checked.min_similarity:.7g}: "
        f"similarity {own.min():.4f} to {own.max():.4f}"
    )
    is_good = reach >= _FEW_REACH * own.size
    return (Verdict.DOUBTFUL if reach and not is_good else is_good), says


@as_check(
    "min_similarity keeps others out",
    "min_similarity is too low: take what few pairs of places reach, or `placerec calibrate`",
    itself,
)
def _kept_out(subject: Subject) -> Outcome:
    threshold = CheckedRecognizer(subject.recognizer).min_similarity
    values = unlike_similarities(subject)
    passing = int((values >= threshold).sum())
    says = (
        f"{passing} of {values.size} pairs reach {threshold:.7g}: "
        f"similarity {values.min():.3f} to {values.max():.3f}"
    )
    if passing >= _NEARLY_ALL_PASS * values.size:
        return False, says
    return (Verdict.DOUBTFUL if passing >= _MOST_PASS * values.size else True), says


CHECKS = (_reached, _kept_out)

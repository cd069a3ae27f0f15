# SPDX-License-Identifier: Apache-2.0
"""A check that memory does not grow with every image."""

import numpy as np

from placerec.conformance.finding import Check, Outcome, judged, not_tried
from placerec.conformance.repetition import FRESH
from placerec.conformance.subject import Subject

MAX_KEPT_MB = 0.4
"""Half an image: what the system counts wavers by less."""


def _keeps_no_images(subject: Subject) -> Outcome:
    kept_mb = subject.fresh_run.kept_mb
    if np.isnan(kept_mb):
        return not_tried("only Linux tells how much memory is taken")
    return judged(kept_mb <= MAX_KEPT_MB, f"{max(kept_mb, 0.0):.2f} MB more after each image")


CHECKS = (
    Check(
        "keeps no images",
        _keeps_no_images,
        "let go of each image and what was made of it; run a network in torch.inference_mode()",
        needs=(FRESH,),
    ),
)

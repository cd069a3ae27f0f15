# SPDX-License-Identifier: Apache-2.0
"""How far away the wrong best matches are: beside the place, or somewhere else."""

from collections.abc import Mapping

import numpy as np

from benchmarks.place_recognition.tables import markdown
from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset
from placerec.datasets.tum import MAX_DISTANCE, STRIDE, pose_distance, read_recording

SUREST = 20
FAR = 1.0


def near_misses_table(desk: PlaceDataset, similarities: Mapping[str, Similarities]) -> str:
    """Return, by method, how far wrong best matches are, in metres plus radians (eq. 10).

    Args:
        desk: a whole recording in TUM RGB-D's format.
        similarities: by method, (N, N) between its images.
    """
    frames = read_recording(desk.paths[0].parents[1], STRIDE)
    distance = pose_distance(frames.positions_m, frames.quaternions)
    has_match = (desk.same_place & desk.comparable).any(axis=1)
    rows = []
    for method, values in similarities.items():
        counted = np.where(desk.comparable, values, -np.inf)
        best = counted.argmax(axis=1)
        reached = distance[np.arange(len(best)), best]
        wrong = np.flatnonzero(reached >= MAX_DISTANCE)
        surest = reached[wrong[np.argsort(-counted.max(axis=1)[wrong], kind="stable")][:SUREST]]
        missed = reached[(reached >= MAX_DISTANCE) & has_match]
        rows.append(
            (
                method,
                f"{surest.min():.2f} to {surest.max():.2f}",
                f"{len(missed)} of {has_match.sum()}",
                f"{np.median(missed):.2f}",
                f"{100 * np.mean(missed < FAR):.0f} %",
            )
        )
    surest_title = f"the {SUREST} surest wrong matches are this far away"
    header = (
        "",
        surest_title,
        "places missed",
        "median distance of what was taken",
        f"below {FAR:g}",
    )
    return markdown(header, rows)

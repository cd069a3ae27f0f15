# SPDX-License-Identifier: Apache-2.0
"""The stretches of a recording that have no place in the trajectory."""

from dataclasses import dataclass

import numpy as np

from slam.output.report.paths import Paths
from slam.result import SlamResult


@dataclass(frozen=True)
class Loss:
    """Frames in a row that could not be placed.

    Attributes:
        start_s, stop_s: seconds since the first frame, of the first and of the last of them.
        frames: how many.
        why: in words.
    """

    start_s: float
    stop_s: float
    frames: int
    why: str


def losses(result: SlamResult, paths: Paths) -> list[Loss]:
    """Return the losses in order of time."""
    lost_s = np.sort(result.untracked_s)
    placed_before = np.searchsorted(result.trajectory.timestamps_s, lost_s)
    unjoined = np.isin(lost_s, result.unjoined_s)
    is_new = (np.diff(placed_before) != 0) | (np.diff(unjoined) != 0)
    found = []
    for part in np.split(np.arange(len(lost_s)), np.flatnonzero(is_new) + 1):
        if len(part):
            start_s, stop_s = paths.elapsed_s(lost_s[part[[0, -1]]]).tolist()
            why = "part of the map that was not joined" if unjoined[part[0]] else "not tracked"
            found.append(Loss(start_s, stop_s, len(part), why))
    return found

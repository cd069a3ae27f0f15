# SPDX-License-Identifier: Apache-2.0
"""Several recordings of one camera, one after the other, that are to make one map."""

from itertools import pairwise

import numpy as np

from slam.datasets.sequence import Sequence
from slam.types import FloatArray, SlamError, Trajectory


class Sessions:
    """Recordings in the order of time; one alone is a session too.

    Attributes:
        recordings: one per session; one whose clock starts again is as many.
        camera: the camera of all.
        ground_truth: the true poses of those that have some, taken to be in one frame of
            reference; None where there are none.
    """

    def __init__(self, recordings: list[Sequence]) -> None:
        """Look whether the recordings can be one map.

        Raises:
            SlamError: their cameras differ, or they do not follow one another in time.
        """
        for before, after in pairwise(recordings):
            _check_camera(before, after)
            _check_order(before, after)
        recordings = [session for each in recordings for session in each.sessions()]
        self.recordings = recordings
        self.camera = recordings[0].camera
        self.ground_truth = _joined_truth(recordings)

    @property
    def timestamps_s(self) -> FloatArray:
        """(N,) times of all frames."""
        return np.concatenate([each.timestamps_s for each in self.recordings])

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know before trusting a run; one sentence each."""
        if len(self.recordings) == 1:
            return self.recordings[0].warnings
        with_truth = [each.name for each in self.recordings if each.ground_truth is not None]
        warnings = [f"{each.name}: {text}" for each in self.recordings for text in each.warnings]
        if 0 < len(with_truth) < len(self.recordings):
            warnings.append(f"only {' and '.join(with_truth)} can be compared with ground truth")
        if len(with_truth) > 1:
            warnings.append(
                f"the true paths of {' and '.join(with_truth)} are taken to be in one frame of"
                " reference; if each has its own, the ATE means nothing"
            )
        return tuple(warnings)


def _check_camera(before: Sequence, after: Sequence) -> None:
    one, other = vars(before.camera), vars(after.camera)
    differing = [name for name in one if one[name] != other[name]]
    if differing:
        has, instead = (
            ", ".join(f"{name} {camera[name]}" for name in differing) for camera in (one, other)
        )
        raise SlamError(
            f"recordings of different cameras cannot be one run: {before.name} has {has},"
            f" {after.name} {instead}; --save the map of one and --load it for the other, or give"
            " the camera of both with --input.camera FILE.toml"
        )


def _check_order(before: Sequence, after: Sequence) -> None:
    (first_s, last_s), (start_s, end_s) = (each.timestamps_s[[0, -1]] for each in (before, after))
    if end_s < first_s:
        raise SlamError(
            f"recordings are given in the order of time: put {after.name}, which ends at"
            f" {end_s:.3f} s, before {before.name}, which begins at {first_s:.3f} s"
        )
    if start_s <= last_s:
        raise SlamError(
            "recordings that are to be one map must follow one another in time: "
            f"{before.name} ends at {last_s:.3f} s, {after.name} begins at {start_s:.3f} s;"
            " run them one by one, or write later times into one of them"
        )


def _joined_truth(recordings: list[Sequence]) -> Trajectory | None:
    """Return the true poses one after the other, cut halfway between two recordings."""
    breaks_s = [
        0.5 * (before.timestamps_s[-1] + after.timestamps_s[0])
        for before, after in pairwise(recordings)
    ]
    starts_s, ends_s = [-np.inf, *breaks_s], [*breaks_s, np.inf]
    parts = []
    for each, start_s, end_s in zip(recordings, starts_s, ends_s, strict=True):
        if each.ground_truth is not None:
            stamps_s = each.ground_truth.timestamps_s
            inside = (stamps_s >= start_s) & (stamps_s < end_s)
            parts.append((stamps_s[inside], each.ground_truth.T_world_cam[inside]))
    if not parts:
        return None
    return Trajectory(*(np.concatenate(column) for column in zip(*parts, strict=True)))

# SPDX-License-Identifier: Apache-2.0
"""What became of a run under stress: figures, kept in a file as soon as they are known."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from placerec.errors import LoopcloseError
from placerec.files import read_json, write_atomically

_WORSE, _WORSE_M = 1.02, 2e-4  # than without loops, before it counts


@dataclass(frozen=True)
class Outcome:
    """One trial; None stands for unknown.

    Attributes:
        stressor, level: what was made worse and by how much.
        ate_odometry_m, ate_without_loops_m, ate_m: root mean square errors of tracking alone, in
            the end without loops, and with; without ground truth, distances from the clean run.
        has_truth: whether they are errors.
        frames, frames_tracked: those that the camera gave, and those of them that have a place.
        loops_kept: loops in use that are not false, as far as is known.
        false_injected: loops that were injected.
        false_kept: loops in use that were, or that are false by ground truth.
        warnings: what the run says of itself.
        ended: why there is no result; empty where there is one.
    """

    stressor: str
    level: float
    ate_odometry_m: float | None
    ate_without_loops_m: float | None
    ate_m: float | None
    has_truth: bool
    frames: int
    frames_tracked: int
    loops_kept: int
    false_injected: int
    false_kept: int
    warnings: tuple[str, ...]
    ended: str = ""

    @property
    def name(self) -> str:
        """The stressor and its level."""
        return f"{self.stressor} {self.level:g}"

    @property
    def tracked_share(self) -> float:
        """Of the frames."""
        return self.frames_tracked / self.frames if self.frames else 0.0

    @property
    def is_worse(self) -> bool:
        """Whether the errors are larger with loops than without."""
        if not self.has_truth or self.ate_m is None or self.ate_without_loops_m is None:
            return False
        before_m = self.ate_without_loops_m
        return self.ate_m > max(_WORSE * before_m, before_m + _WORSE_M)


def write_outcome(path: Path, outcome: Outcome) -> None:
    """Write it for `read_outcome`.

    Raises:
        LoopcloseError: it cannot be written.
    """
    write_atomically(path, json.dumps(asdict(outcome), indent=2) + "\n")


def read_outcome(path: Path) -> Outcome | None:
    """Read one back, None where there is none that can be."""
    try:
        told = read_json(path)
        return Outcome(**{**told, "warnings": tuple(told["warnings"])})
    except (LoopcloseError, TypeError, KeyError):
        return None

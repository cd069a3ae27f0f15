# SPDX-License-Identifier: Apache-2.0
"""What both commands that compare trajectories are told: how to measure."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from slam.types import SlamError

if TYPE_CHECKING:
    from slam.evaluation.comparison import ComparisonConfig

_WITH_TIMES, _WITHOUT = "1m,1s", "1m"


@dataclass(frozen=True, kw_only=True)
class Measuring:
    """How to measure, and where to write it."""

    align: Annotated[Literal["se3", "sim3", "origin", "none"], tyro.conf.arg(metavar="HOW")] = "se3"
    """Lay it on the truth by se3, sim3, origin or none."""
    rpe: Annotated[str | None, tyro.conf.arg(metavar="1m,5m,1s,10f")] = None
    """Relative errors over metres, seconds, frames; default: 1m, and 1s if there are times."""
    all_pairs: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Of metres and frames every pair; else one after the other."""
    max_time_difference: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 0.02
    """Poses further apart are not compared."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for table.csv, .tex, figures.json and drawings."""

    def config(self, *, has_times: bool = True) -> "ComparisonConfig":
        """Return what was asked for.

        Raises:
            SlamError: a value is not allowed, or needs times where there are none.
        """
        from slam.evaluation.comparison import Alignment, ComparisonConfig
        from slam.evaluation.pose_errors import read_deltas

        tolerance_s = self.max_time_difference
        if not 0.0 < tolerance_s < float("inf"):
            raise SlamError(f"--max-time-difference {tolerance_s:g}: it has to be above 0, seconds")
        deltas = read_deltas(self.rpe or (_WITH_TIMES if has_times else _WITHOUT))
        in_time = [str(each) for each in deltas if each.unit == "s"]
        if in_time and not has_times:
            raise SlamError(
                f"--rpe {self.rpe}: there are no times to tell what is {in_time[0]} apart; give"
                " metres or frames"
            )
        return ComparisonConfig(Alignment(self.align), tolerance_s, deltas, self.all_pairs)


def write_files(folder: Path, contents: Mapping[str, bytes | str]) -> None:
    """Write files by name into a folder, which is made where there is none.

    Raises:
        LoopcloseError: they cannot be written.
    """
    from placerec.files import write_atomically

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SlamError(f"cannot make the folder: {error.strerror}: {folder}") from error
    for name, content in contents.items():
        write_atomically(folder / name, content)

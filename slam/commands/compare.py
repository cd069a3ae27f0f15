# SPDX-License-Identifier: Apache-2.0
"""`run_slam compare`: finished runs side by side."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from placerec.commands import usage
from placerec.commands.console import say
from slam.commands.measuring import Measuring, write_files
from slam.types import SlamError

if TYPE_CHECKING:
    from slam.output.comparison.rows import SideBySide
    from slam.output.comparison.tables import Table

_DESCRIPTION = """Compare finished runs: errors, loops, warnings, and settings that differ.

  run_slam compare runs/demo runs/strict            two runs of a sequence
  run_slam compare runs/* --rpe 1m,5m,1s            sequences are kept apart
  run_slam compare runs/a runs/b --out comparison   LaTeX, CSV and drawings, too

Runs without ground truth are compared with another run: distances, no errors."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Measuring):
    """What run_slam compare was asked to do."""

    runs: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RUN ...", help_behavior_hint="(at least one)"),
    ]
    """Folders that run_slam wrote."""


def main(typed: list[str]) -> int:
    """Compare the runs that were named, and return the exit code.

    Raises:
        LoopcloseError: something is wrong with what was typed, or with a run.
    """
    told = usage.parsed(Arguments, "run_slam compare", _DESCRIPTION, typed)
    if not told.runs:
        raise SlamError("compare needs folders that run_slam wrote; see run_slam compare --help")
    # Loaded from here on, so that --help and typing errors answer at once.
    from slam.output.comparison.rows import side_by_side
    from slam.output.comparison.runs import read_runs
    from slam.output.comparison.side_by_side import tables
    from slam.output.comparison.tables import as_text

    config = told.config()
    found = [side_by_side(group, config) for group in read_runs(told.runs)]
    shown = [table for each in found for table in tables(each)]
    say("\n\n\n".join(map(as_text, shown)))
    if told.out is not None:
        _write(told.out, found, shown)
        say(f"\nwritten to {told.out}")
    return 0


def _write(folder: Path, found: "list[SideBySide]", shown: "list[Table]") -> None:
    import json
    import re

    from slam.output.comparison.plots import plots
    from slam.output.comparison.rows import TRUTH, in_full, rows_in_full
    from slam.output.comparison.tables import as_csv, as_latex

    rows = [row for each in found for row in rows_in_full(each)]
    contents: dict[str, bytes | str] = {
        "table.tex": as_latex(shown),
        "figures.json": json.dumps([in_full(each) for each in found], indent=2) + "\n",
    }
    if rows:
        contents["table.csv"] = as_csv(rows)
    write_files(folder, contents)
    for number, each in enumerate(found, start=1):
        name = re.sub(r"[^\w+.-]", "_", each.group.sequence)
        for what, some in (("", each.errors), ("distances-", each.distances)):
            curves = {
                f"{row.run.name}, {row.estimate}"
                + ("" if row.reference == TRUTH else f" from {row.reference}"): row.comparison
                for row in some
                if row.comparison
            }
            drawn = plots(curves, has_times=True) if curves else {}
            prefix = f"{number}-{name}-{what}"
            write_files(folder, {f"{prefix}{file}": content for file, content in drawn.items()})

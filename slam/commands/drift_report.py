# SPDX-License-Identifier: Apache-2.0
"""The command `drift_report`: how far the poses of any system are from the truth."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from placerec.commands import usage
from placerec.commands.console import answer, say
from slam.commands.measuring import Measuring, write_files

if TYPE_CHECKING:
    from slam.datasets.pose_files import PoseFile
    from slam.evaluation.comparison import Comparison
    from slam.output.comparison.tables import Table

_DESCRIPTION = """Compare poses of any system with the truth: APE, RPE, and what is behind them.

  drift_report estimate.txt truth.txt              TUM, KITTI or EuRoC files
  drift_report slam.txt data.csv --align sim3      one camera: its scale is free
  drift_report est.txt gt.txt --rpe 1m,5m,1s,30f   metres, seconds, frames apart
  drift_report est.txt gt.txt --out report         LaTeX, CSV and drawings, too"""


@dataclass(frozen=True, kw_only=True)
class Arguments(Measuring):
    """What drift_report was asked to do."""

    estimate: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ESTIMATE")]
    """File of estimated poses."""
    truth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TRUTH")]
    """File of true ones; lines without times are matched by row."""


def main(arguments: list[str] | None = None) -> int:
    """Run `drift_report` and return its exit code: 0 good, 2 something the user can mend."""
    typed = sys.argv[1:] if arguments is None else arguments
    return answer("drift_report", typed, _work, interrupted="interrupted before it was done")


def _work(typed: list[str]) -> int:
    told = usage.parsed(Arguments, "drift_report", _DESCRIPTION, typed)
    # Loaded from here on, so that --help and typing errors answer at once.
    from slam.datasets.pose_files import read_trajectory
    from slam.evaluation.comparison import compare
    from slam.output.comparison.tables import as_text

    truth, estimate = read_trajectory(told.truth), read_trajectory(told.estimate)
    files = (estimate, truth)
    has_times = all(each.format.has_time for each in files)
    config = told.config(has_times=has_times)
    comparison = compare(estimate.trajectory, truth.trajectory, config, by_row=not has_times)
    table = _table(told, files, comparison)
    say(as_text(table))
    if told.out is not None:
        _write(told, table, comparison, has_times)
        say(f"{'written':<10} {told.out}")
    return 0


def _table(
    told: Arguments, files: "tuple[PoseFile, PoseFile]", comparison: "Comparison"
) -> "Table":
    from slam.output.comparison.figures import UNKNOWN, evidence_lines, figures
    from slam.output.comparison.tables import Table

    found = figures(comparison)
    rows = [
        (
            each.name,
            *(f"{value:.6f}" if each.count else UNKNOWN for value in each.values),
            str(each.count),
        )
        for each in found
    ]
    named = zip(("estimate", "truth"), (told.estimate, told.truth), files, strict=True)
    read = [
        (name, f"{path}: {len(file.trajectory)} pose(s), read as {file.format.name}")
        for name, path, file in named
    ]
    return Table(
        f"{told.estimate.name} compared with {told.truth.name}",
        ("", *found[0].values._fields, "count"),
        tuple(rows),
        (*read, *evidence_lines(comparison)),
    )


def _write(told: Arguments, table: "Table", comparison: "Comparison", has_times: bool) -> None:
    import json

    from slam.output.comparison.figures import csv_rows, report
    from slam.output.comparison.plots import plots
    from slam.output.comparison.tables import as_csv, as_latex

    names = {"estimate": str(told.estimate), "truth": str(told.truth)}
    contents: dict[str, bytes | str] = {
        "table.csv": as_csv(csv_rows(names, comparison)),
        "table.tex": as_latex([table]),
        "figures.json": json.dumps({**names, **report(comparison)}, indent=2) + "\n",
    }
    folder = told.out or Path()
    write_files(folder, contents)
    write_files(folder, plots({told.estimate.name: comparison}, has_times=has_times))


if __name__ == "__main__":
    sys.exit(main())

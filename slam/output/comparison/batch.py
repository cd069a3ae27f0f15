# SPDX-License-Identifier: Apache-2.0
"""Runs of many recordings: which are done already, and all of them in one table and on one page."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from placerec.errors import LoopcloseError
from placerec.files import is_file
from slam.config import Config, load_config
from slam.output.claimed_folder import JOURNAL, UNFINISHED
from slam.output.comparison.page import as_page
from slam.output.comparison.runs import in_one, read_summary
from slam.output.comparison.tables import Table, as_csv

PAGE, FIGURES = "batch.html", "batch.csv"
"""What is written beside the folders of the runs."""

_COUNTS = ("frames_tracked", "frames_untracked", "keyframes")
_LOOPS = ("loops_accepted", "loops_tried", "loops_false", "loops_judged")
_ERRORS_M = ("ate_odometry_m", "ate_without_loops_m", "ate_corrected_m")
_BEHIND = (
    *("matched_share", "truth_coverage", "association_tolerance_s", "alignment", "scale"),
    *("elapsed_s", "frames_per_second"),
)
_HEADER = (
    *("", "", "tracked", "loops", "false", "odometry", "without", "with"),
    *("matched %", "covered %", "warnings", "s"),
)
_DONE, _FAILED, _UNKNOWN = "done", "failed", "-"
_ERRORS = (
    "ATE, m, RMSE after SE(3) alignment, scale not adjusted: of tracking alone, and in the end"
    " without loops and with them; - where there is no ground truth"
)
_MATCHED = "of the tracked frames, those with a true pose at most {} ms apart"


@dataclass(frozen=True)
class Outcome:
    """What became of a recording.

    Attributes:
        name: of its run, and of the folder of that.
        summary: what the run tells of itself, empty where it did not come to its end.
        why: it did not; empty where it did.
    """

    name: str
    summary: dict[str, object]
    why: str = ""

    @property
    def warnings(self) -> int | None:
        """How many the run gave, None where that is not known."""
        told = self.summary.get("warnings")
        return len(told) if isinstance(told, list) else None


def summary_of_done(folder: Path) -> dict[str, object] | None:
    """Return the summary of a run that came to its end with nothing missing, else None."""
    if (folder / UNFINISHED / JOURNAL).exists():
        return None
    try:
        summary = read_summary(folder)
    except LoopcloseError:
        return None
    files, problems = summary.get("files"), summary.get("problems")
    if not isinstance(files, list) or problems != []:
        return None
    return summary if all(is_file(folder / str(name)) for name in files) else None


def what_differs(
    folder: Path, summary: dict[str, object], command: Sequence[str], config: Config
) -> str:
    """Return what of the run in a folder is not as it would be by a command; "" where all is.

    Raises:
        LoopcloseError: its settings cannot be read.
    """
    try:
        told = shlex.split(str(summary.get("command")))
    except ValueError:  # an open quote
        told = []
    if told[:1] != ["run_slam"] or told[2:] != list(command[2:]):
        return f"it is of `{summary.get('command')}`"
    if Path(told[1]).resolve() != Path(command[1]).resolve():
        return f"it is of the recording {told[1]}"
    before = in_one(load_config(folder / "settings.toml").model_dump())
    return ", ".join(
        f"{name} is {before[name]} there and {value} here"
        for name, value in in_one(config.model_dump()).items()
        if before[name] != value
    )


def table(outcomes: Sequence[Outcome]) -> Table:
    """Return a row for each recording, and what stands behind the figures."""
    failed = [each for each in outcomes if each.why]
    title = f"{len(outcomes)} recordings"
    if failed:
        title += f", {len(failed)} of which failed"
    tolerances_s = {each.summary.get("association_tolerance_s") for each in outcomes}
    apart_ms = ", ".join(sorted(f"{1e3 * s:.3g}" for s in tolerances_s if isinstance(s, float)))
    notes = [
        ("errors", _ERRORS),
        *([("matched", _MATCHED.format(apart_ms))] if apart_ms else []),
        ("covered", "how much of the run's time its ground truth covers"),
        ("false", "of the loops in use that ground truth covers, those that it contradicts"),
        *((_FAILED, f"{each.name}: {each.why}") for each in failed),
    ]
    return Table(title, _HEADER, tuple(map(_row, outcomes)), tuple(notes), texts=2)


def as_files(outcomes: Sequence[Outcome]) -> dict[str, bytes | str]:
    """Return batch.csv and batch.html, which leads to the report of each run that is done."""
    links = {each.name: f"{each.name}/report.html" for each in outcomes if not each.why}
    return {
        FIGURES: as_csv([_in_full(each) for each in outcomes]),
        PAGE: as_page(table(outcomes), links),
    }


def _in_full(outcome: Outcome) -> dict[str, object]:
    keys = (*_COUNTS, *_LOOPS, *_ERRORS_M, *_BEHIND)
    figures = {key: outcome.summary.get(key) for key in keys}
    state = _FAILED if outcome.why else _DONE
    why = {"warnings": outcome.warnings, "why": outcome.why}
    return {"run": outcome.name, "state": state, **figures, **why}


def _row(outcome: Outcome) -> tuple[str, ...]:
    if outcome.why:
        return (outcome.name, _FAILED, *[_UNKNOWN] * (len(_HEADER) - 2))
    told = outcome.summary
    tracked, untracked = told.get("frames_tracked"), told.get("frames_untracked")
    frames = tracked + untracked if isinstance(tracked, int) and isinstance(untracked, int) else "?"
    return (
        outcome.name,
        _DONE,
        f"{tracked}/{frames}",
        f"{told.get('loops_accepted')}/{told.get('loops_tried')}",
        _UNKNOWN if told.get("loops_false") is None else f"{told['loops_false']}",
        *(_number(told.get(key), ".4f") for key in _ERRORS_M),
        *(_number(told.get(key), ".0%").rstrip("%") for key in ("matched_share", "truth_coverage")),
        _UNKNOWN if outcome.warnings is None else f"{outcome.warnings}",
        _number(told.get("elapsed_s"), ".0f"),
    )


def _number(value: object, how: str) -> str:
    return format(value, how) if isinstance(value, int | float) else _UNKNOWN

# SPDX-License-Identifier: Apache-2.0
"""Estimates of runs, each compared with the truth, or with another run where there is none."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slam.evaluation.comparison import (
    Alignment,
    Comparison,
    ComparisonConfig,
    RelativeErrors,
    compare,
)
from slam.evaluation.pose_errors import Delta, Statistics
from slam.output.comparison.figures import (
    Figure,
    csv_rows,
    figures,
    known,
    record,
    report,
)
from slam.output.comparison.runs import ESTIMATES, FinishedRun, Group
from slam.types import SlamError, Trajectory

TRUTH = "truth"


@dataclass(frozen=True)
class Row:
    """One estimate of a run, compared with the truth or with another run.

    Attributes:
        run, estimate: which it is.
        reference: `TRUTH`, or the name of the run that it is compared with.
        comparison: None where the run kept no poses of it, or where it cannot be compared.
        why: it cannot be compared; empty where it can.
    """

    run: FinishedRun
    estimate: str
    reference: str
    comparison: Comparison | None
    why: str = ""

    @cached_property
    def rmse(self) -> dict[str, float | None]:
        """The root mean square errors by the names of the figures, None where unknown."""
        if self.why:
            return {}
        if self.comparison is None:
            found = _of_summary(self.run, self.estimate)
            return {each.name: each.values.rmse for each in found}
        return {each.name: known(each.values.rmse) for each in figures(self.comparison)}


def _of_summary(run: FinishedRun, estimate: str) -> list[Figure]:
    """Return the figures that a run's own summary tells, without those of it that it does not."""
    key, interval_s = ESTIMATES[estimate], run.number("rpe_interval_s")
    delta = "" if interval_s is None else str(Delta(interval_s, "s"))
    found: list[tuple[str, str, str, float | None]] = [
        ("APE", "", "m", run.number(f"ate_{key}_m")),
        ("RPE", delta, "m", run.number(f"rpe_translation_{key}_m")),
        ("RPE", delta, "deg", run.number(f"rpe_rotation_{key}_deg")),
    ]
    return [
        Figure(metric, over, unit, None, Statistics(rmse, *[math.nan] * 5))
        for metric, over, unit, rmse in found
        if rmse is not None
    ]


def behind_summary(run: FinishedRun, estimate: str) -> dict[str, object]:
    """Return the evidence for those, as far as the summary tells, by the keys of `evidence`."""
    is_live = estimate == "live"
    frames = run.number("frames_live" if is_live else "frames_tracked")
    share = None if is_live else run.number("matched_share")
    return {
        "association": "the run's own summary",
        "matched": None if share is None or frames is None else round(share * frames),
        "estimate_poses": None if frames is None else round(frames),
        "allowed_time_difference_s": run.number("association_tolerance_s"),
        "truth_covers": None if is_live else run.number("truth_coverage"),
        "alignment": "SE(3)",
        "scale": run.number("scale"),
    }


@dataclass(frozen=True)
class SideBySide:
    """The runs of one sequence, compared.

    Attributes:
        group, config: which runs, and how.
        errors: rows of the runs that have truth.
        distances: rows of those that have none: how far they are from another run.
    """

    group: Group
    config: ComparisonConfig
    errors: tuple[Row, ...]
    distances: tuple[Row, ...]


def side_by_side(group: Group, config: ComparisonConfig) -> SideBySide:
    """Compare the estimates of runs with their truth, and those without it with another run."""
    errors = [row for run in group.runs if run.truth for row in _errors(run, run.truth, config)]
    reference = next((run for run in group.runs if run.truth), group.runs[0])
    distances = [
        _row(run, list(run.trajectories)[-1], reference.name, run.final, reference.final, config)
        for run in group.runs
        if run.truth is None and run is not reference
    ]
    return SideBySide(group, config, tuple(errors), tuple(distances))


def _errors(run: FinishedRun, truth: Trajectory, config: ComparisonConfig) -> Iterable[Row]:
    as_the_run = config.alignment == Alignment.SE3
    as_the_run &= config.max_time_difference_s == run.number("association_tolerance_s")
    for estimate, key in ESTIMATES.items():
        if estimate in run.trajectories:
            yield _row(run, estimate, TRUTH, run.trajectories[estimate], truth, config)
        elif run.number(f"ate_{key}_m") is not None and as_the_run:
            yield Row(run, estimate, TRUTH, None)


def _row(
    run: FinishedRun,
    estimate: str,
    reference: str,
    path: Trajectory,
    other: Trajectory,
    config: ComparisonConfig,
) -> Row:
    try:
        found = compare(path, other, config, session_starts_s=run.session_starts_s or ())
    except SlamError as error:
        return Row(run, estimate, reference, None, str(error))
    if reference == TRUTH and not run.tells_rotations:
        found = _positions_alone(found)
    return Row(run, estimate, reference, found)


def _positions_alone(found: Comparison) -> Comparison:
    """Return the same without what depends on how the camera turned in truth."""
    nothing = np.zeros(0)
    rpe = tuple(RelativeErrors(each.delta, nothing, nothing) for each in found.rpe)
    return replace(found, ape_deg=nothing, rpe=rpe, by_length=())


def rows_in_full(found: SideBySide) -> list[dict[str, object]]:
    """Return every figure of every estimate for a CSV file, with all of its evidence."""
    rows: list[dict[str, object]] = []
    for row in (*found.errors, *found.distances):
        names = {
            "sequence": found.group.sequence,
            "run": row.run.name,
            "estimate": row.estimate,
            "compared_with": row.reference,
        }
        if row.comparison:
            rows += csv_rows(names, row.comparison)
        elif not row.why:
            behind = behind_summary(row.run, row.estimate)
            rows += [
                {**names, **record(each), **behind} for each in _of_summary(row.run, row.estimate)
            ]
    return rows


def in_full(found: SideBySide) -> dict[str, object]:
    """Return all that is known of the runs of one sequence, for programs."""
    group = found.group
    return {
        "sequence": group.sequence,
        "runs": [
            {
                "run": run.name,
                "has_truth": run.truth is not None,
                "session_starts_s": run.session_starts_s,
                **{
                    key: run.number(key)
                    for key in ("loops_tried", "loops_accepted", "loops_judged", "loops_false")
                },
                "warnings": run.warnings,
                "settings": {name: each[i] for name, each in group.differing.items()},
            }
            for i, run in enumerate(group.runs)
        ],
        "estimates": [_in_full(row) for row in (*found.errors, *found.distances)],
    }


def _in_full(row: Row) -> dict[str, object]:
    names = {"run": row.run.name, "estimate": row.estimate, "compared_with": row.reference}
    if row.comparison:
        return {**names, **report(row.comparison)}
    if row.why:
        return {**names, "why_not": row.why}
    return {
        **names,
        "evidence": behind_summary(row.run, row.estimate),
        "figures": [record(each) for each in _of_summary(row.run, row.estimate)],
    }

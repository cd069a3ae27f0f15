# SPDX-License-Identifier: Apache-2.0
"""All trials together: how much is tolerated, as a table, as JSON and as CSV."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from slam.output.comparison.tables import Table, as_csv
from slam.output.stress.outcome import Outcome
from slam.output.stress.stressors import STRESSORS

AS_CLEAN, MOSTLY_TRACKED = 1.1, 0.9
"""Tolerated is what leaves the error within 10 % of the clean run's, and 90 % of the frames."""

Trials = Mapping[str, Sequence[Outcome]]
"""By stressor, the levels rising."""

_UNKNOWN = "-"
_HEADER = ("", "level", "odometry", "without", "with", "of clean", "tracked", "loops", "false", "")


def tolerated(clean: Outcome, trials: Sequence[Outcome]) -> float | None:
    """Return the highest level up to which all are tolerated, 0 for none.

    None where that is unknown: nothing was tried, or the clean run has no error to compare with.
    """
    if _most_tolerated(clean) is None or not trials:
        return None
    most = 0.0
    for each in trials:
        if not is_tolerated(clean, each):
            break
        most = each.level
    return most


def is_tolerated(clean: Outcome, outcome: Outcome) -> bool:
    """Whether a run under stress is about as good as the clean one."""
    most = _most_tolerated(clean)
    if outcome.ate_m is None or most is None:
        return False
    is_placed = outcome.tracked_share >= MOSTLY_TRACKED * clean.tracked_share
    return outcome.ate_m <= most and is_placed


def _most_tolerated(clean: Outcome) -> float | None:
    if not clean.has_truth:
        return clean.ate_without_loops_m
    return None if clean.ate_m is None else AS_CLEAN * clean.ate_m


def table(title: str, clean: Outcome, trials: Trials) -> Table:
    """Return the figures and what stands behind them."""
    rows = [_row(clean, each) for each in (clean, *_flat(trials))]
    what = "ATE, m, RMSE after SE(3) alignment, scale not adjusted"
    if not clean.has_truth:
        what = "there is no ground truth: how far from the clean run's path with loops, m, RMSE"
    notes = [
        ("errors", f"{what}: of tracking alone, and in the end without loops and with them"),
        ("loops", "in use and not false, as far as is known"),
        ("false", "loops in use that were injected / of those, or that are false by ground truth"),
        ("at the end", "w: the run warns of something; !: it is worse with loops than without"),
        ("tolerated", _in_words(clean, trials)),
    ]
    return Table(title, _HEADER, tuple(rows), tuple(notes))


def as_files(clean: Outcome, trials: Trials, asked: Mapping[str, object]) -> dict[str, bytes | str]:
    """Return tolerance.json, with what was asked, and tolerance.csv, with warnings counted."""
    told = {
        **asked,
        "clean": asdict(clean),
        "stressors": {
            name: {
                "unit": STRESSORS[name].unit,
                "tolerated": tolerated(clean, some),
                "trials": [{**asdict(each), "worse_with_loops": each.is_worse} for each in some],
            }
            for name, some in trials.items()
        },
    }
    rows = [
        {**asdict(each), "warnings": len(each.warnings), "worse_with_loops": each.is_worse}
        for each in (clean, *_flat(trials))
    ]
    return {"tolerance.json": json.dumps(told, indent=2) + "\n", "tolerance.csv": as_csv(rows)}


def _flat(trials: Trials) -> list[Outcome]:
    return [each for some in trials.values() for each in some]


def _row(clean: Outcome, outcome: Outcome) -> tuple[str, ...]:
    share = _UNKNOWN
    if clean.has_truth and clean.ate_m and outcome.ate_m is not None:
        share = f"{outcome.ate_m / clean.ate_m:.2f}"
    false = f"{outcome.false_kept}"
    if outcome.false_injected:
        false += f"/{outcome.false_injected}"
    said = "w" * bool(outcome.warnings or outcome.ended) + "!" * outcome.is_worse
    return (
        outcome.stressor,
        f"{outcome.level:g}",
        *map(_metres, (outcome.ate_odometry_m, outcome.ate_without_loops_m, outcome.ate_m)),
        share,
        f"{outcome.frames_tracked}/{outcome.frames}",
        f"{outcome.loops_kept}",
        false,
        said,
    )


def _metres(value: float | None) -> str:
    return _UNKNOWN if value is None else f"{value:.4f}"


def _in_words(clean: Outcome, trials: Trials) -> str:
    found = {name: tolerated(clean, some) for name, some in trials.items()}
    levels = ", ".join(
        f"{name} unknown" if level is None else f"{name} {level:g}" for name, level in found.items()
    )
    within = "within 10 % of the clean run's error"
    if not clean.has_truth:
        within = "no further from the clean run than that is without its loops"
    return f"{levels or 'nothing was tried'}: up to there {within}, with 90 % of its frames"

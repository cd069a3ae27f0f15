# SPDX-License-Identifier: Apache-2.0
"""Runs side by side, for people: a row for each estimate, and what differs between the runs."""

import numpy as np

from slam.evaluation.comparison import Alignment, Comparison
from slam.output.comparison.figures import UNKNOWN, evidence_lines
from slam.output.comparison.rows import TRUTH, Row, SideBySide, behind_summary
from slam.output.comparison.runs import FinishedRun, Group
from slam.output.comparison.tables import Table

_ABSOLUTE = ("APE (m)", "APE (deg)")
_ROTATIONS = "(deg)"
_NOT_TOLD = "-"
_OF_SUMMARY = (
    "where only the trajectories' errors were kept, as of live and without loops, they are those of"
    " the run's own summary.json; it does not tell what is - or ?"
)
_BREAKS_UNKNOWN = (
    "it is of several recordings, but its summary.json does not tell when each starts, so that the"
    " breaks between them count as gaps, and pairs of RPE lead across them"
)
_LEFT_OUT = (
    "live and without loops: a run keeps no poses of them, and the figures in its summary.json are"
    " after another alignment, or within another time difference"
)


def tables(found: SideBySide) -> list[Table]:
    """Return what is shown of the runs of one sequence."""
    shown = []
    if found.errors:
        notes = (*_notes(found, found.errors), *_about_runs(found.group))
        shown.append(_table(f"{found.group.sequence}: errors (RMSE)", found, found.errors, notes))
    if found.distances:
        about = () if found.errors else _about_runs(found.group)
        notes = (*_notes(found, found.distances), *about)
        title = f"{found.group.sequence}: distances from {found.distances[0].reference}, RMS"
        shown.append(_table(f"{title}; no errors", found, found.distances, notes))
    if not shown:
        (run,) = found.group.runs
        nothing = f"{run.name} has no ground truth, and no other run is of its sequence"
        empty = (("compared", nothing), *_about_runs(found.group))
        shown.append(Table(found.group.sequence, ("run",), ((run.name,),), empty))
    return shown


def _table(
    title: str, found: SideBySide, rows: tuple[Row, ...], notes: tuple[tuple[str, str], ...]
) -> Table:
    deltas = [f"RPE {each} ({unit})" for each in found.config.deltas for unit in ("m", "deg")]
    names = (*_ABSOLUTE, *deltas)
    headers = tuple("deg" if name.endswith(_ROTATIONS) else name for name in names)
    is_scaled = found.config.alignment == Alignment.SIM3
    scale = ("scale",) if is_scaled else ()
    return Table(
        title,
        ("run", "estimate", *headers, *scale, "matched", "covered %", "ms apart"),
        tuple(
            (
                row.run.name,
                row.estimate,
                *(_number(row.rmse.get(name), row.comparison) for name in names),
                *((_scale(row),) if is_scaled else ()),
                *_behind(row),
            )
            for row in rows
        ),
        notes,
        texts=2,
    )


def _number(value: float | None, comparison: Comparison | None) -> str:
    if value is not None:
        return f"{value:.4f}"
    return UNKNOWN if comparison else _NOT_TOLD


def _scale(row: Row) -> str:
    return f"{row.comparison.scale:.4f}" if row.comparison else _NOT_TOLD


def _behind(row: Row) -> tuple[str, str, str]:
    """Return how many poses matched, how much of the time is covered, how far they are apart."""
    if row.comparison:
        association = row.comparison.association
        covers = association.truth_covers, association.estimate_covers
        return (
            f"{association.matched}/{association.estimate_poses}",
            "/".join(f"{100.0 * share:.0f}" for share in covers),
            f"{1e3 * association.most_apart_s:.1f}",
        )
    if row.why:
        return (_NOT_TOLD,) * 3
    told = behind_summary(row.run, row.estimate)
    share = told["truth_covers"]
    by_truth = f"{100.0 * share:.0f}/?" if isinstance(share, float) else _NOT_TOLD
    return f"{_or_not(told['matched'])}/{_or_not(told['estimate_poses'])}", by_truth, _NOT_TOLD


def _or_not(count: object) -> str:
    return "?" if count is None else str(count)


def _notes(found: SideBySide, rows: tuple[Row, ...]) -> tuple[tuple[str, str], ...]:
    tolerance_ms = 1e3 * found.config.max_time_difference_s
    scale = "adjusted" if found.config.alignment == Alignment.SIM3 else "not adjusted"
    aligned = {
        Alignment.SE3: "SE(3), over all matched positions of each row",
        Alignment.SIM3: "Sim(3), over all matched positions of each row",
        Alignment.ORIGIN: "the first matched pose of each row on its true one",
        Alignment.NONE: "not at all",
    }[found.config.alignment]
    notes = [
        (
            "matched",
            "of the estimate's poses, those with one of the reference nearest in time, at most"
            f" {tolerance_ms:.3g} ms apart",
        ),
        (
            "covered",
            "how much of the estimate's time the reference covers, and of the reference's the"
            " estimate; gaps over 0.5 s are left out",
        ),
        ("aligned", f"{aligned}; the scale was {scale}"),
    ]
    compared = next((row.comparison for row in rows if row.comparison), None)
    if compared:
        notes += [note for note in evidence_lines(compared) if note[0] == "RPE"]
    if any(row.comparison is None and not row.why for row in rows):
        notes.append(("summary", _OF_SUMMARY))
    elif rows[0].reference == TRUTH:
        notes.append(("left out", _LEFT_OUT))
    if rows[0].reference != TRUTH:
        names = ", ".join(dict.fromkeys(row.run.name for row in rows))
        notes.append(
            (
                "no truth",
                f"of {names}: these are distances from the poses of {rows[0].reference} in the end,"
                " which tell how alike runs are, not which one is right",
            )
        )
    for row in rows:
        left_open = row.comparison.undetermined if row.comparison else ""
        for said in filter(None, (row.why, left_open)):
            notes.append(("warning", f"{row.run.name}, {row.estimate}: {said}"))
    return tuple(notes)


def _about_runs(group: Group) -> tuple[tuple[str, str], ...]:
    notes = [("loops", f"{run.name}: {_loops(run)}") for run in group.runs]
    for run in group.runs:
        count = run.warnings
        said = "unknown" if count is None else f"{count}, in its report.html" if count else "none"
        notes.append(("warnings", f"{run.name}: {said}"))
        if run.session_starts_s is None:
            notes.append(("warning", f"{run.name}: {_BREAKS_UNKNOWN}"))
        if run.truth and not run.tells_rotations:
            unjudged = "its truth does not tell how the camera turned, so that only APE (m) is"
            notes.append(("warning", f"{run.name}: {unjudged}"))
    if len(group.runs) > 1:
        names = [run.name for run in group.runs]
        for setting, values in group.differing.items():
            pairs = zip(names, values, strict=True)
            notes.append(("settings", f"{setting}: {', '.join(f'{v} in {n}' for n, v in pairs)}"))
        if not group.differing:
            notes.append(("settings", "the same in all"))
        if not _have_one_truth(group):
            notes.append(("warning", "the runs were compared with truths that are not the same"))
    return tuple(notes)


def _loops(run: FinishedRun) -> str:
    accepted, tried = run.number("loops_accepted"), run.number("loops_tried")
    if accepted is None or tried is None:
        return "unknown"
    said = f"{accepted:.0f} accepted of {tried:.0f} candidates"
    judged, false = run.number("loops_judged"), run.number("loops_false")
    if not judged or false is None:
        return f"{said}; none of them checked by truth"
    return f"{said}; {false:.0f} of {judged:.0f} checked are false"


def _have_one_truth(group: Group) -> bool:
    truths = [run.truth for run in group.runs if run.truth]
    return all(
        np.array_equal(each.timestamps_s, truths[0].timestamps_s)
        and np.array_equal(each.T_world_cam, truths[0].T_world_cam)
        for each in truths
    )

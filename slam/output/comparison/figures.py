# SPDX-License-Identifier: Apache-2.0
"""The figures of a comparison, and the evidence that goes with each: what was compared, and how."""

import math
from dataclasses import dataclass

import numpy as np

from slam.evaluation.comparison import Alignment, Comparison, RelativeErrors
from slam.evaluation.coverage import MAX_GAP_S
from slam.evaluation.pose_errors import Statistics, statistics
from slam.geometry import se3
from slam.types import FloatArray

ALIGNMENTS = {
    Alignment.SE3: "SE(3)",
    Alignment.SIM3: "Sim(3)",
    Alignment.ORIGIN: "first poses",
    Alignment.NONE: "none",
}
UNKNOWN = "unknown"


@dataclass(frozen=True)
class Figure:
    """One kind of error, told in numbers.

    Attributes:
        metric: APE or RPE.
        delta: that poses of a relative error are apart; empty for absolute ones.
        unit: m or deg.
        count: of the errors; None where that is not known.
        values: what is told of them.
    """

    metric: str
    delta: str
    unit: str
    count: int | None
    values: Statistics

    @property
    def name(self) -> str:
        """What it is called in tables."""
        return " ".join(part for part in (self.metric, self.delta, f"({self.unit})") if part)


def figures(comparison: Comparison) -> list[Figure]:
    """Return all of a comparison: absolute errors, then relative ones, metres before degrees."""
    found = [
        _figure("APE", "", "m", comparison.ape_m),
        _figure("APE", "", "deg", comparison.ape_deg),
    ]
    for each in comparison.rpe:
        found += _relative(each)
    return found


def _relative(errors: RelativeErrors) -> list[Figure]:
    delta = str(errors.delta)
    return [
        _figure("RPE", delta, "m", errors.translation_m),
        _figure("RPE", delta, "deg", errors.rotation_deg),
    ]


def _figure(metric: str, delta: str, unit: str, errors: FloatArray) -> Figure:
    return Figure(metric, delta, unit, len(errors), statistics(errors))


def known(value: float) -> float | None:
    """Return a number as JSON has it: None where it is not known."""
    return value if math.isfinite(value) else None


def evidence(comparison: Comparison) -> dict[str, object]:
    """Return what stands behind the figures, for programs; every key says its unit."""
    association, config = comparison.association, comparison.config
    missing_s = np.diff(association.missing_s, axis=1)
    return {
        "association": "row" if association.by_row else "nearest in time",
        "matched": association.matched,
        "estimate_poses": association.estimate_poses,
        "truth_poses": association.truth_poses,
        "max_time_difference_s": known(association.most_apart_s),
        "allowed_time_difference_s": None if association.by_row else config.max_time_difference_s,
        "truth_covers": known(association.truth_covers),
        "estimate_covers": known(association.estimate_covers),
        "missing_s": None if association.by_row else float(missing_s.sum()),
        "alignment": ALIGNMENTS[config.alignment],
        "scale": comparison.scale,
        "best_scale": known(comparison.best_scale),
        "undetermined": comparison.undetermined,
        "estimate_length_m": association.estimate_length_m,
        "truth_length_m": association.truth_length_m,
        "pairs": "all" if config.all_pairs else "consecutive",
    }


def report(comparison: Comparison) -> dict[str, object]:
    """Return a comparison for programs: evidence and figures; None stands for unknown."""
    return {
        "evidence": evidence(comparison),
        "figures": [record(each) for each in figures(comparison)],
        "rpe_by_length": [
            record(each) for errors in comparison.by_length for each in _relative(errors)
        ],
    }


def record(figure: Figure) -> dict[str, object]:
    """Return a figure for programs."""
    values = {name: known(value) for name, value in figure.values._asdict().items()}
    keys = {"metric": figure.metric, "delta": figure.delta, "unit": figure.unit}
    return {**keys, **values, "count": figure.count}


def csv_rows(names: dict[str, str], comparison: Comparison) -> list[dict[str, object]]:
    """Return a row for each figure, of what is compared and all of its evidence."""
    behind = evidence(comparison)
    return [{**names, **record(each), **behind} for each in figures(comparison)]


def in_brief(comparison: Comparison) -> str:
    """Return what stands behind the figures in a few words, for legends."""
    association, config = comparison.association, comparison.config
    scale = f", scale {comparison.scale:.4g}" if config.alignment == Alignment.SIM3 else ""
    how = "not aligned" if config.alignment == Alignment.NONE else ALIGNMENTS[config.alignment]
    return f"{association.matched} of {association.estimate_poses} poses, {how}{scale}"


def evidence_lines(comparison: Comparison) -> list[tuple[str, str]]:
    """Return what stands behind the figures, for people: a name and a sentence each."""
    association = comparison.association
    lines = [
        ("matched", _matched(comparison)),
        ("covered", _covered(comparison)),
        ("missing", _missing(comparison)),
        ("aligned", _aligned(comparison)),
        ("RPE", _pairs(comparison)),
    ]
    if comparison.undetermined:
        lines.append(("warning", f"{comparison.undetermined}: APE (deg) is unknown"))
    if association.matched < association.estimate_poses:
        left_out = association.estimate_poses - association.matched
        lines.append(("warning", f"{left_out} poses of the estimate were not compared"))
    return lines


def _matched(comparison: Comparison) -> str:
    association = comparison.association
    counts = (
        f"{association.matched} of {association.estimate_poses} poses of the estimate,"
        f" {association.matched} of {association.truth_poses} of the truth,"
    )
    if association.by_row:
        return f"{counts} by row: not both files have times that would show whether that is right"
    allowed_ms = 1e3 * comparison.config.max_time_difference_s
    apart_ms = 1e3 * association.most_apart_s
    return f"{counts} nearest in time, at most {apart_ms:.3g} ms apart ({allowed_ms:.3g} allowed)"


def _covered(comparison: Comparison) -> str:
    association = comparison.association
    ways = (
        f"ways through the matched poses: {association.estimate_length_m:.3f} m estimated,"
        f" {association.truth_length_m:.3f} m true"
    )
    if association.by_row:
        return ways
    return (
        f"{association.truth_covers:.1%} of the estimate's time by the truth,"
        f" {association.estimate_covers:.1%} of the truth's by the estimate, without gaps of over"
        f" {MAX_GAP_S:g} s; {ways}"
    )


def _missing(comparison: Comparison) -> str:
    association = comparison.association
    if association.by_row:
        return "nothing, if rows belong together"
    lengths_s = np.diff(association.missing_s, axis=1)[:, 0]
    if len(lengths_s) == 0:
        return f"nothing: no gap of the estimate in the truth's time is over {MAX_GAP_S:g} s"
    start_s, end_s = association.missing_s[np.argmax(lengths_s)]
    return (
        f"{lengths_s.sum():.2f} of {association.span_s:.2f} s of the truth have no estimate, in"
        f" {len(lengths_s)} gap(s) over {MAX_GAP_S:g} s; the longest from {start_s:.3f} to"
        f" {end_s:.3f} s"
    )


def _aligned(comparison: Comparison) -> str:
    alignment, T = comparison.config.alignment, comparison.T_truth_world
    turned_deg = float(np.rad2deg(se3.rotation_angle(T)))
    by = f"turned by {turned_deg:.2f} deg, moved by {float(se3.translation_norm(T)):.3f} m"
    how = {
        Alignment.SE3: f"SE(3), over all matched positions: {by}",
        Alignment.SIM3: f"Sim(3), over all matched positions: {by}",
        Alignment.ORIGIN: f"the first matched pose on its true one: {by}",
        Alignment.NONE: "not at all",
    }[alignment]
    if alignment == Alignment.SIM3:
        return f"{how}; the scale was adjusted, by {comparison.scale:.6g}"
    best = comparison.best_scale
    would = f" (Sim(3) would take {best:.4g})" if math.isfinite(best) else ""
    return f"{how}; the scale was not adjusted{would}"


def _pairs(comparison: Comparison) -> str:
    config, units = comparison.config, {each.delta.unit for each in comparison.rpe}
    ways = []
    if units & {"m", "f"}:
        along = " along the estimate's way" if "m" in units else ""
        which = "all pairs" if config.all_pairs else "one pair after the other"
        ways.append(f"{which}{along}")
    if "s" in units:
        within_ms = 1e3 * config.max_time_difference_s
        ways.append(f"of seconds, all pairs that are so far apart within {within_ms:.3g} ms")
    return "; ".join(ways)

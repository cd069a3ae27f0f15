# SPDX-License-Identifier: Apache-2.0
"""Any trajectory compared with another, and all that is needed to trust the figures."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from placerec.datasets.tum_lists import nearest
from slam.evaluation.association import Association, associated
from slam.evaluation.coverage import sessions
from slam.evaluation.pose_errors import (
    Delta,
    Pairs,
    pairs_along,
    pairs_in_time,
    pairs_of_frames,
    relative_errors,
)
from slam.evaluation.trajectory import MIN_ALIGNED, align, scale_between
from slam.geometry import se3
from slam.types import FloatArray, SlamError, Trajectory

_ON_A_LINE = 1e-6  # of the spread along it, that across it is less: a thousandth of its length
_LENGTHS, _SERIES = 8, (1.0, 2.0, 5.0)


class Alignment(StrEnum):
    """How an estimate is laid on the truth before their positions are compared."""

    SE3 = "se3"
    SIM3 = "sim3"
    ORIGIN = "origin"
    NONE = "none"


@dataclass(frozen=True)
class ComparisonConfig:
    """How to compare.

    Attributes:
        alignment: before absolute errors; a scale counts for relative ones, too.
        max_time_difference_s: poses further apart in time do not belong together.
        deltas: of relative errors.
        all_pairs: of distances and frames take every pair, not one after the other.
    """

    alignment: Alignment = Alignment.SE3
    max_time_difference_s: float = 0.02
    deltas: tuple[Delta, ...] = (Delta(1.0, "m"), Delta(1.0, "s"))
    all_pairs: bool = False


@dataclass(frozen=True)
class RelativeErrors:
    """Errors of the motions between poses that are so far apart: (P,) metres and degrees."""

    delta: Delta
    translation_m: FloatArray
    rotation_deg: FloatArray


@dataclass(frozen=True)
class Comparison:
    """How far an estimate is from the truth.

    Attributes:
        config, association: what the figures are of.
        times_s: (M,) of the matched poses of the estimate; numbers of rows where there are none.
        T_truth_world, scale: the alignment, p_truth = T_truth_world @ (scale * p_world).
        best_scale: what an alignment with a scale would take; NaN where there is none.
        undetermined: what the alignment leaves open, for people; empty where nothing.
        aligned_m, truth_m: (M, 3) positions.
        ape_m, ape_deg: (M,) absolute errors; ape_deg is empty where a rotation is left open.
        rpe: relative errors, one for each delta.
        by_length: the same of all pairs along a series of distances.
    """

    config: ComparisonConfig
    association: Association
    times_s: FloatArray
    T_truth_world: FloatArray
    scale: float
    best_scale: float
    undetermined: str
    aligned_m: FloatArray
    truth_m: FloatArray
    ape_m: FloatArray
    ape_deg: FloatArray
    rpe: tuple[RelativeErrors, ...]
    by_length: tuple[RelativeErrors, ...]


def compare(
    estimate: Trajectory,
    truth: Trajectory,
    config: ComparisonConfig,
    *,
    by_row: bool = False,
    session_starts_s: Sequence[float] = (),
) -> Comparison:
    """Compare an estimate with the truth, by time or, where lines have none, by row.

    Of several recordings in a row, session_starts_s are the times at which all but the first
    start: no way leads from one to the next, and no count of frames.

    Raises:
        SlamError: too few poses belong together, a scale cannot be told, or there is no time.
    """
    association, matched, true = associated(
        estimate, truth, config.max_time_difference_s, by_row, session_starts_s
    )
    _refuse_too_few(estimate, truth, len(matched), config)
    T_truth_world, scale, best_scale = _alignment(matched, true, config.alignment)
    undetermined = ""
    if config.alignment in (Alignment.SE3, Alignment.SIM3):
        undetermined = _undetermined(matched, true)
    scaled = matched.enlarged(scale)
    T_truth_cam = T_truth_world @ scaled.T_world_cam
    off = se3.inverse(T_truth_cam) @ true.T_world_cam
    aligned_m, truth_m = T_truth_cam[:, :3, 3], true.T_world_cam[:, :3, 3]

    def relative(delta: Delta, *, all_pairs: bool) -> RelativeErrors:
        pairs = _pairs(scaled, delta, config, all_pairs, session_starts_s)
        errors = relative_errors(scaled.T_world_cam, true.T_world_cam, pairs)
        return RelativeErrors(delta, *errors)

    return Comparison(
        config=config,
        association=association,
        times_s=matched.timestamps_s,
        T_truth_world=T_truth_world,
        scale=scale,
        best_scale=best_scale,
        undetermined=undetermined,
        aligned_m=aligned_m,
        truth_m=truth_m,
        ape_m=np.linalg.norm(aligned_m - truth_m, axis=1),
        ape_deg=np.zeros(0) if undetermined else np.rad2deg(se3.rotation_angle(off)),
        rpe=tuple(relative(each, all_pairs=config.all_pairs) for each in config.deltas),
        by_length=tuple(relative(each, all_pairs=True) for each in _lengths(association)),
    )


def _refuse_too_few(
    estimate: Trajectory, truth: Trajectory, matched: int, config: ComparisonConfig
) -> None:
    needed = MIN_ALIGNED if config.alignment in (Alignment.SE3, Alignment.SIM3) else 1
    if matched >= needed:
        return
    closest = nearest(truth.timestamps_s, estimate.timestamps_s)
    gap_s = np.abs(truth.timestamps_s[closest] - estimate.timestamps_s).min()
    name = "" if needed == 1 else f" for the alignment {config.alignment}"
    raise SlamError(
        f"only {matched} of {len(estimate)} poses have one of the truth in time, {needed} are"
        f" needed{name}: the closest gap is {gap_s:.6g} s, {config.max_time_difference_s:g} s are"
        " allowed; check that both use one clock, or raise --max-time-difference"
    )


def _alignment(
    matched: Trajectory, true: Trajectory, alignment: Alignment
) -> tuple[FloatArray, float, float]:
    """Return T_truth_world, the scale that comes before it, and the scale that would be best."""
    positions_m, truth_m = matched.T_world_cam[:, :3, 3], true.T_world_cam[:, :3, 3]
    T_truth_world = align(positions_m, truth_m)
    best_scale = scale_between(se3.transform(T_truth_world, positions_m), truth_m)
    if alignment == Alignment.SIM3:
        if not best_scale > 0.0:
            raise SlamError(
                "the estimate stays in one place, or does not move as the truth does, so that there"
                " is no scale to be found; use another --align"
            )
        return align(best_scale * positions_m, truth_m), best_scale, best_scale
    if alignment == Alignment.ORIGIN:
        T_truth_world = true.T_world_cam[0] @ se3.inverse(matched.T_world_cam[0])
    elif alignment == Alignment.NONE:
        T_truth_world = np.eye(4)
    return T_truth_world, 1.0, best_scale


def _undetermined(matched: Trajectory, true: Trajectory) -> str:
    """Return what positions leave open of an alignment: a rotation, where they lie on a line."""
    a, b = (
        each.T_world_cam[:, :3, 3] - each.T_world_cam[:, :3, 3].mean(axis=0)
        for each in (matched, true)
    )
    along, across, _ = np.linalg.svd(b.T @ a, compute_uv=False)
    if along <= 0.0:
        return "the positions stay in one place, so that no rotation can be told"
    if across < _ON_A_LINE * along:
        return "the positions lie on a line, so that the rotation about it cannot be told"
    return ""


def _pairs(
    estimate: Trajectory,
    delta: Delta,
    config: ComparisonConfig,
    all_pairs: bool,
    starts_s: Sequence[float],
) -> Pairs:
    if delta.unit == "s":
        return pairs_in_time(estimate.timestamps_s, delta.amount, config.max_time_difference_s)
    first, second, before = [], [], 0
    for session in sessions(estimate, starts_s):
        pairs = _pairs_of_session(session, delta, all_pairs)
        first.append(pairs.first + before)
        second.append(pairs.second + before)
        before += len(session)
    return Pairs(np.concatenate(first), np.concatenate(second))


def _pairs_of_session(session: Trajectory, delta: Delta, all_pairs: bool) -> Pairs:
    if delta.unit == "f":
        return pairs_of_frames(len(session), int(delta.amount), all_pairs=all_pairs)
    return pairs_along(session.T_world_cam[:, :3, 3], delta.amount, all_pairs=all_pairs)


def _lengths(association: Association) -> list[Delta]:
    """Return distances, as 1, 2, 5, 10, up to half of the way."""
    most_m = 0.5 * association.truth_length_m
    if not most_m > 0.0:
        return []
    top = int(np.floor(np.log10(most_m)))
    series = [each * 10.0**power for power in range(top - 3, top + 1) for each in _SERIES]
    return [Delta(float(f"{each:.6g}"), "m") for each in series if each <= most_m][-_LENGTHS:]

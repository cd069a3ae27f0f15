# SPDX-License-Identifier: Apache-2.0
"""What ground truth says of the motions that were measured between keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.config import EvaluationConfig
from slam.evaluation.trajectory import poses_at
from slam.geometry import se3
from slam.types import FloatArray, Keyframe, Link, LoopAttempt, RelativePose, Trajectory

RIGHT_MEDIAN_NEES = 5.35
"""Median of chi-square with six degrees of freedom: that of motions as wrong as they claim."""


@dataclass(frozen=True)
class LoopTruth:
    """What ground truth says of one loop attempt; NaN where it does not cover both keyframes.

    Attributes:
        translation_error_m, rotation_error_deg: of the measured motion, NaN where geometry found
            none; loops that the pose graph outvoted have one.
        true_distance_m, true_angle_deg: between the two cameras in truth.
        is_false: an accepted loop whose motion is off by more than the limits; None where truth
            is unknown or the loop was not accepted in the end.
        nees: of the measured motion, see `nees`; NaN where geometry found none.
    """

    translation_error_m: float = np.nan
    rotation_error_deg: float = np.nan
    true_distance_m: float = np.nan
    true_angle_deg: float = np.nan
    is_false: bool | None = None
    nees: float = np.nan


def nees(measured: RelativePose, T_ref_query: FloatArray) -> float:
    """Return the normalised estimation error squared of a motion, against its (4, 4) truth.

    That is the squared error in units of the standard deviations it claims (Bar-Shalom et al.,
    Estimation with Applications to Tracking and Navigation, 5.4). Where the claims are right, its
    median is `RIGHT_MEDIAN_NEES`; more means larger errors than claimed. NaN where the truth is.
    """
    return float(_nees([measured], T_ref_query[None])[0])


def judge_links(
    links: Sequence[Link],
    keyframes: Sequence[Keyframe],
    truth: Trajectory,
    config: EvaluationConfig,
) -> FloatArray:
    """Return the (L,) `nees` of links, NaN where ground truth does not cover both keyframes."""
    pairs = [(each.ref_id, each.query_id) for each in links]
    return _nees([each.motion for each in links], _true_motions(pairs, keyframes, truth, config))


def judge_loops(
    attempts: Sequence[LoopAttempt],
    keyframes: Sequence[Keyframe],
    truth: Trajectory,
    config: EvaluationConfig,
) -> tuple[LoopTruth, ...]:
    """Return what ground truth says of each loop attempt, in the same order."""
    pairs = [(each.match_id, each.query_id) for each in attempts]
    T_match_query = _true_motions(pairs, keyframes, truth, config)
    distances_m, angles_deg = _sizes(T_match_query)
    motions = [each.motion for each in attempts]
    moved = np.array([motion is not None for motion in motions], bool)
    measured = [motion for motion in motions if motion is not None]
    errors_m, errors_deg, squared = np.full((3, len(attempts)), np.nan)
    squared[moved] = _nees(measured, T_match_query[moved])
    errors_m[moved], errors_deg[moved] = _sizes(_errors(measured, T_match_query[moved]))
    columns = (errors_m, errors_deg, distances_m, angles_deg, squared)
    found = []
    for attempt, *numbers in zip(attempts, *(each.tolist() for each in columns), strict=True):
        error_m, error_deg, distance_m, angle_deg, nees_there = numbers
        is_known = attempt.rejection is None and not np.isnan(distance_m)
        is_off = error_m > config.false_loop_translation_m
        is_off |= error_deg > config.false_loop_rotation_deg
        is_false = is_off if is_known else None
        found.append(LoopTruth(error_m, error_deg, distance_m, angle_deg, is_false, nees_there))
    return tuple(found)


def _true_motions(
    pairs: Sequence[tuple[int, int]],
    keyframes: Sequence[Keyframe],
    truth: Trajectory,
    config: EvaluationConfig,
) -> FloatArray:
    """Return the (N, 4, 4) motions from ids (reference, query) of keyframes, NaN if unknown."""
    stamps_s = np.array([keyframe.timestamp_s for keyframe in keyframes])
    T_truth_cam = poses_at(truth, stamps_s, config.max_time_difference_s)
    row_of = {keyframe.id: row for row, keyframe in enumerate(keyframes)}
    rows = np.array([(row_of[ref], row_of[query]) for ref, query in pairs], np.int64).reshape(-1, 2)
    T_truth_ref, T_truth_query = (T_truth_cam[each] for each in rows.T)
    T_ref_query = se3.inverse(T_truth_ref) @ T_truth_query
    T_ref_query[np.isnan(T_ref_query).any(axis=(1, 2))] = np.nan
    return np.asarray(T_ref_query)


def _errors(measured: Sequence[RelativePose], T_ref_query: FloatArray) -> FloatArray:
    T_measured = np.array([each.T_ref_query for each in measured]).reshape(-1, 4, 4)
    return np.asarray(se3.inverse(T_ref_query) @ T_measured)


def _nees(measured: Sequence[RelativePose], T_ref_query: FloatArray) -> FloatArray:
    """Return (N,) `nees` of motions against (N, 4, 4) true ones, NaN where those are."""
    found = np.full(len(measured), np.nan)
    known = np.flatnonzero(np.isfinite(T_ref_query).all(axis=(1, 2)))
    some = [measured[n] for n in known.tolist()]
    error = se3.log(se3.inverse(_errors(some, T_ref_query[known])))
    information = np.array([each.information for each in some]).reshape(-1, 6, 6)
    found[known] = np.einsum("ni,nij,nj->n", error, information, error)
    return found


def _sizes(T_a_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    return se3.translation_norm(T_a_b), np.rad2deg(se3.rotation_angle(T_a_b))

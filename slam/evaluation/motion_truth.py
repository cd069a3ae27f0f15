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
    if np.isnan(T_ref_query).any():
        return np.nan
    error = se3.log(se3.inverse(measured.T_ref_query) @ T_ref_query)
    return float(error @ measured.information @ error)


def judge_links(
    links: Sequence[Link],
    keyframes: Sequence[Keyframe],
    truth: Trajectory,
    config: EvaluationConfig,
) -> FloatArray:
    """Return the (L,) `nees` of links, NaN where ground truth does not cover both keyframes."""
    T_truth_cam = _true_poses(keyframes, truth, config)
    found = [nees(each.motion, _between(T_truth_cam, each.ref_id, each.query_id)) for each in links]
    return np.array(found, dtype=np.float64)


def judge_loops(
    attempts: Sequence[LoopAttempt],
    keyframes: Sequence[Keyframe],
    truth: Trajectory,
    config: EvaluationConfig,
) -> tuple[LoopTruth, ...]:
    """Return what ground truth says of each loop attempt, in the same order."""
    T_truth_cam = _true_poses(keyframes, truth, config)
    return tuple(
        _judge(each, _between(T_truth_cam, each.match_id, each.query_id), config)
        for each in attempts
    )


def _true_poses(
    keyframes: Sequence[Keyframe], truth: Trajectory, config: EvaluationConfig
) -> dict[int, FloatArray]:
    stamps_s = np.array([keyframe.timestamp_s for keyframe in keyframes])
    poses = poses_at(truth, stamps_s, config.max_time_difference_s)
    return {keyframe.id: pose for keyframe, pose in zip(keyframes, poses, strict=True)}


def _between(T_truth_cam: dict[int, FloatArray], ref_id: int, query_id: int) -> FloatArray:
    return se3.inverse(T_truth_cam[ref_id]) @ T_truth_cam[query_id]


def _judge(attempt: LoopAttempt, T_match_query: FloatArray, config: EvaluationConfig) -> LoopTruth:
    if np.isnan(T_match_query).any():
        return LoopTruth()
    distance_m, angle_deg = _size(T_match_query)
    measured = attempt.motion
    if measured is None:
        return LoopTruth(true_distance_m=distance_m, true_angle_deg=angle_deg)
    error_m, error_deg = _size(se3.inverse(T_match_query) @ measured.T_ref_query)
    is_off = error_m > config.false_loop_translation_m or error_deg > config.false_loop_rotation_deg
    is_false = is_off if attempt.rejection is None else None
    squared = nees(measured, T_match_query)
    return LoopTruth(error_m, error_deg, distance_m, angle_deg, is_false, squared)


def _size(T_a_b: FloatArray) -> tuple[float, float]:
    return float(se3.translation_norm(T_a_b)), float(np.rad2deg(se3.rotation_angle(T_a_b)))

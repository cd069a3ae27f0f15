# SPDX-License-Identifier: Apache-2.0
"""How far an estimate is from the truth: ATE, RPE, and which loops were right."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from placerec.datasets.tum_lists import nearest
from slam.config import EvaluationConfig
from slam.evaluation.trajectory import align, associate, path_length_m
from slam.geometry import se3
from slam.types import FloatArray, Keyframe, LoopAttempt, SlamError, Trajectory

_MAX_TRUTH_GAP_S = 0.5  # ground truth without a pose for longer than this counts as interrupted
_MIN_MATCHED_POSES = 3  # fewer positions do not fix an alignment in space


@dataclass(frozen=True)
class TrajectoryError:
    """Error of one estimated trajectory against ground truth.

    Attributes:
        timestamps_s: (M,) float64, the compared frames.
        T_truth_world: (4, 4), the SE(3) alignment (no scale) that the ATE was taken after.
        position_errors_m: (M,) float64, after alignment.
        ate_rmse_m: root mean square of the position errors.
        rpe_translation_m, rpe_rotation_deg: root mean square relative pose error over the interval;
            NaN where no two compared frames are that far apart.
        matched_share: share of the estimated poses that have a true pose in time.
    """

    timestamps_s: FloatArray
    T_truth_world: FloatArray
    position_errors_m: FloatArray
    ate_rmse_m: float
    rpe_translation_m: float
    rpe_rotation_deg: float
    matched_share: float


@dataclass(frozen=True)
class LoopTruth:
    """What ground truth says of one loop attempt; NaN where it does not cover both keyframes.

    Attributes:
        translation_error_m, rotation_error_deg: of the measured motion, NaN where geometry found
            none; loops that the pose graph outvoted have one.
        true_distance_m, true_angle_deg: between the two cameras in truth.
        is_false: an accepted loop whose motion is off by more than the limits; None where truth
            is unknown or the loop was not accepted in the end.
    """

    translation_error_m: float = np.nan
    rotation_error_deg: float = np.nan
    true_distance_m: float = np.nan
    true_angle_deg: float = np.nan
    is_false: bool | None = None


@dataclass(frozen=True)
class DriftReport:
    """Drift before and after loop closure, with all that is needed to trust the figures.

    Attributes:
        before, after: errors of the odometry and of the corrected trajectory.
        loops: one entry per loop attempt, in the same order.
        tolerance_s: association tolerance between estimated and true poses.
        coverage: share of the sequence's time span that ground truth covers.
        rpe_interval_s: interval of the relative pose error.
        truth_length_m: length of the true path over the compared frames.
    """

    before: TrajectoryError
    after: TrajectoryError
    loops: tuple[LoopTruth, ...]
    tolerance_s: float
    coverage: float
    rpe_interval_s: float
    truth_length_m: float


def trajectory_error(
    estimate: Trajectory, truth: Trajectory, config: EvaluationConfig
) -> TrajectoryError:
    """Compare an estimate with ground truth at the poses that are nearest in time.

    Raises:
        SlamError: fewer than three poses match; the message tells the closest time gap.
    """
    tolerance_s = config.max_time_difference_s
    if len(estimate) == 0 or len(truth) == 0:
        raise SlamError(
            "the estimate or the ground truth holds no poses; there is nothing to compare"
        )
    in_estimate, in_truth = associate(estimate, truth, tolerance_s)
    if len(in_estimate) < _MIN_MATCHED_POSES:
        closest = nearest(truth.timestamps_s, estimate.timestamps_s)
        gap_s = np.abs(truth.timestamps_s[closest] - estimate.timestamps_s).min()
        raise SlamError(
            f"only {len(in_estimate)} of {len(estimate)} poses have ground truth in time, "
            f"{_MIN_MATCHED_POSES} are needed: the closest gap is {gap_s:.6g} s, the tolerance "
            f"{tolerance_s:g} s; check that both use one clock, or raise "
            "evaluation.max_time_difference_s"
        )
    T_world_cam, T_truth_cam = estimate.T_world_cam[in_estimate], truth.T_world_cam[in_truth]
    T_truth_world = align(T_world_cam[:, :3, 3], T_truth_cam[:, :3, 3])
    aligned_m = se3.transform(T_truth_world, T_world_cam[:, :3, 3])
    position_errors_m = np.linalg.norm(aligned_m - T_truth_cam[:, :3, 3], axis=1)
    stamps_s = estimate.timestamps_s[in_estimate]
    interval_s = config.rpe_interval_s
    first, second = np.arange(len(stamps_s)), nearest(stamps_s, stamps_s + interval_s)
    is_pair = np.abs(stamps_s[second] - stamps_s - interval_s) <= tolerance_s
    is_pair &= second > first
    first, second = first[is_pair], second[is_pair]
    T_true = se3.inverse(T_truth_cam[first]) @ T_truth_cam[second]
    T_measured = se3.inverse(T_world_cam[first]) @ T_world_cam[second]
    error = se3.inverse(T_true) @ T_measured
    return TrajectoryError(
        timestamps_s=stamps_s,
        T_truth_world=T_truth_world,
        position_errors_m=position_errors_m,
        ate_rmse_m=_root_mean_square(position_errors_m),
        rpe_translation_m=_root_mean_square(se3.translation_norm(error)),
        rpe_rotation_deg=_root_mean_square(np.rad2deg(se3.rotation_angle(error))),
        matched_share=len(in_estimate) / len(estimate),
    )


def compare_drift(
    odometry: Trajectory,
    corrected: Trajectory,
    truth: Trajectory,
    attempts: Sequence[LoopAttempt],
    keyframes: Sequence[Keyframe],
    config: EvaluationConfig,
    session_starts_s: Sequence[float] | FloatArray = (),
) -> DriftReport:
    """Measure the drift before and after loop closure, and judge every loop attempt.

    Raises:
        SlamError: fewer than three poses match ground truth in time.
    """
    before = trajectory_error(odometry, truth, config)
    _, in_truth = associate(odometry, truth, config.max_time_difference_s)
    compared = Trajectory(truth.timestamps_s[in_truth], truth.T_world_cam[in_truth])
    return DriftReport(
        before=before,
        after=trajectory_error(corrected, truth, config),
        loops=judge_loops(attempts, keyframes, truth, config),
        tolerance_s=config.max_time_difference_s,
        coverage=coverage(odometry, truth, session_starts_s),
        rpe_interval_s=config.rpe_interval_s,
        truth_length_m=sum(path_length_m(each) for each in _sessions(compared, session_starts_s)),
    )


def judge_loops(
    attempts: Sequence[LoopAttempt],
    keyframes: Sequence[Keyframe],
    truth: Trajectory,
    config: EvaluationConfig,
) -> tuple[LoopTruth, ...]:
    """Return what ground truth says of each loop attempt, in the same order."""
    stamps_s = np.array([keyframe.timestamp_s for keyframe in keyframes])
    in_truth = nearest(truth.timestamps_s, stamps_s)
    is_known = np.abs(truth.timestamps_s[in_truth] - stamps_s) <= config.max_time_difference_s
    T_truth_cam = {
        keyframe.id: truth.T_world_cam[index]
        for keyframe, index, known in zip(keyframes, in_truth, is_known, strict=True)
        if known
    }
    return tuple(_judge(attempt, T_truth_cam, config) for attempt in attempts)


def coverage(
    estimate: Trajectory, truth: Trajectory, session_starts_s: Sequence[float] | FloatArray = ()
) -> float:
    """Return the share of an estimate's time span, 0 to 1, during which there is ground truth.

    The breaks before sessions that start later are no part of it.
    """
    is_covered = np.diff(truth.timestamps_s) <= _MAX_TRUTH_GAP_S
    covered_s = total_s = 0.0
    for session in _sessions(estimate, session_starts_s):
        start_s, end_s = session.timestamps_s[0], session.timestamps_s[-1]
        stamps_s = np.clip(truth.timestamps_s, start_s, end_s)
        covered_s += float(np.diff(stamps_s)[is_covered].sum())
        total_s += end_s - start_s
    return covered_s / total_s if total_s > 0.0 else 0.0


def _sessions(
    trajectory: Trajectory, session_starts_s: Sequence[float] | FloatArray
) -> list[Trajectory]:
    splits = np.searchsorted(trajectory.timestamps_s, session_starts_s)
    columns = (np.split(each, splits) for each in vars(trajectory).values())
    return [Trajectory(*part) for part in zip(*columns, strict=True) if len(part[0])]


def _judge(
    attempt: LoopAttempt, T_truth_cam: Mapping[int, FloatArray], config: EvaluationConfig
) -> LoopTruth:
    if not {attempt.match_id, attempt.query_id} <= T_truth_cam.keys():
        return LoopTruth()
    T_match_query = se3.inverse(T_truth_cam[attempt.match_id]) @ T_truth_cam[attempt.query_id]
    distance_m, angle_deg = _size(T_match_query)
    measured = attempt.motion
    if measured is None:
        return LoopTruth(true_distance_m=distance_m, true_angle_deg=angle_deg)
    error_m, error_deg = _size(se3.inverse(T_match_query) @ measured.T_ref_query)
    is_off = error_m > config.false_loop_translation_m or error_deg > config.false_loop_rotation_deg
    is_false = is_off if attempt.rejection is None else None
    return LoopTruth(error_m, error_deg, distance_m, angle_deg, is_false)


def _size(T_a_b: FloatArray) -> tuple[float, float]:
    return float(se3.translation_norm(T_a_b)), float(np.rad2deg(se3.rotation_angle(T_a_b)))


def _root_mean_square(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")

# SPDX-License-Identifier: Apache-2.0
"""How far an estimate is from the truth: ATE, RPE, and which loops were right."""

from dataclasses import dataclass

from slam.types import FloatArray


@dataclass(frozen=True)
class TrajectoryError:
    """Error of one estimated trajectory against ground truth.

    Attributes:
        timestamps_s: (M,) float64, the compared frames.
        T_truth_world: (4, 4), the SE(3) alignment (no scale) that the ATE was taken after.
        position_errors_m: (M,) float64, after alignment.
        ate_rmse_m: root mean square of the position errors.
        rpe_translation_m, rpe_rotation_deg: root mean square relative pose error over the interval.
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
        translation_error_m, rotation_error_deg: of the measured motion, NaN for rejected loops.
        true_distance_m, true_angle_deg: between the two cameras in truth.
        is_false: an accepted loop whose motion is off by more than the limits; None if unknown.
    """

    translation_error_m: float
    rotation_error_deg: float
    true_distance_m: float
    true_angle_deg: float
    is_false: bool | None


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

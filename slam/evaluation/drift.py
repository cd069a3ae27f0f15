# SPDX-License-Identifier: Apache-2.0
"""How far a run is from the truth: ATE and RPE of its trajectories, NEES of its motions."""

from dataclasses import dataclass, field, replace

import numpy as np

from placerec.datasets.tum_lists import nearest
from slam.config import EvaluationConfig
from slam.evaluation.camera_truth import camera_truth
from slam.evaluation.coverage import coverage, sessions
from slam.evaluation.leave_one_out import helped_m
from slam.evaluation.motion_truth import LoopTruth, judge_links, judge_loops
from slam.evaluation.pose_errors import pairs_in_time, relative_errors, root_mean_square
from slam.evaluation.trajectory import MIN_ALIGNED, align, associate, path_length_m
from slam.geometry import se3
from slam.result import SlamResult
from slam.types import FloatArray, SlamError, Trajectory


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
class DriftReport:
    """Drift live and in the end, without loops and with, and all that is needed to trust it.

    Attributes:
        odometry, live, without_loops, corrected: errors of the result's four trajectories, none of
            them smoothed; live is None where too few of its frames match.
        smoothed: error of the corrected trajectory as smoothed, None where it was not.
        loops: one entry per loop attempt, in the same order.
        helped_m: (A,) per loop attempt, how much larger the ATE of the keyframes would be without
            it, NaN of one not in use.
        before_more_loops: error of the corrected trajectory before loops were looked for again,
            None where they were not.
        links_nees: (L,) `nees` of the result's links, in the same order, NaN where unknown.
        tolerance_s: association tolerance between estimated and true poses.
        coverage: share of the sequence's time span that ground truth covers.
        rpe_interval_s: interval of the relative pose error.
        truth_length_m: length of the true path over the compared frames.
        truth: the true poses of the camera that all was compared with.
        doubts: what a user should know of the ground truth, one sentence each.
        unjudged: why ground truth cannot say whether loops are right, nor tell relative errors and
            the NEES; empty where it can.
    """

    odometry: TrajectoryError
    live: TrajectoryError | None
    without_loops: TrajectoryError
    corrected: TrajectoryError
    smoothed: TrajectoryError | None
    loops: tuple[LoopTruth, ...]
    links_nees: FloatArray
    tolerance_s: float
    coverage: float
    rpe_interval_s: float
    truth_length_m: float
    truth: Trajectory
    doubts: tuple[str, ...] = ()
    unjudged: str = ""
    helped_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    before_more_loops: TrajectoryError | None = None

    @property
    def median_links_nees(self) -> float:
        """Median of the links that truth covers, NaN without any."""
        return _median(self.links_nees)

    @property
    def median_loops_nees(self) -> float:
        """Median of the accepted loops that truth covers, NaN without any."""
        accepted = [loop.nees for loop in self.loops if loop.is_false is not None]
        return _median(np.array(accepted))


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
    if len(in_estimate) < MIN_ALIGNED:
        closest = nearest(truth.timestamps_s, estimate.timestamps_s)
        gap_s = np.abs(truth.timestamps_s[closest] - estimate.timestamps_s).min()
        raise SlamError(
            f"only {len(in_estimate)} of {len(estimate)} poses have ground truth in time, "
            f"{MIN_ALIGNED} are needed: the closest gap is {gap_s:.6g} s, the tolerance "
            f"{tolerance_s:g} s; check that both use one clock, or raise "
            "--evaluation.max-time-difference-s"
        )
    T_world_cam, T_truth_cam = estimate.T_world_cam[in_estimate], truth.T_world_cam[in_truth]
    T_truth_world = align(T_world_cam[:, :3, 3], T_truth_cam[:, :3, 3])
    aligned_m = se3.transform(T_truth_world, T_world_cam[:, :3, 3])
    position_errors_m = np.linalg.norm(aligned_m - T_truth_cam[:, :3, 3], axis=1)
    stamps_s = estimate.timestamps_s[in_estimate]
    pairs = pairs_in_time(stamps_s, config.rpe_interval_s, tolerance_s)
    errors_m, errors_deg = relative_errors(T_world_cam, T_truth_cam, pairs)
    return TrajectoryError(
        timestamps_s=stamps_s,
        T_truth_world=T_truth_world,
        position_errors_m=position_errors_m,
        ate_rmse_m=root_mean_square(position_errors_m),
        rpe_translation_m=root_mean_square(errors_m),
        rpe_rotation_deg=root_mean_square(errors_deg),
        matched_share=len(in_estimate) / len(estimate),
    )


def compare_drift(result: SlamResult, truth: Trajectory, config: EvaluationConfig) -> DriftReport:
    """Measure the drift of a run, and judge all motions that it measured between keyframes.

    Truth of another body, clock, unit or order than the camera's is read as what it is where that
    is well known; where it says nothing of how the camera turned, nothing is judged by that.

    Raises:
        SlamError: fewer than three poses match ground truth in time, or it stays in one place.
    """
    found = camera_truth(result.corrected, truth, config.max_time_difference_s)
    truth = found.trajectory
    rows, in_truth = associate(result.odometry, truth, config.max_time_difference_s)
    # By the frames' times, so that each true pose is in the session of its frame.
    compared = Trajectory(result.odometry.timestamps_s[rows], truth.T_world_cam[in_truth])
    starts_s = result.session_starts_s
    is_smoothed = result.unsmoothed is not None
    drift = DriftReport(
        odometry=trajectory_error(result.odometry, truth, config),
        live=_error_of_some(result.live, truth, config),
        without_loops=trajectory_error(result.without_loops, truth, config),
        corrected=trajectory_error(result.corrected, truth, config),
        smoothed=trajectory_error(result.trajectory, truth, config) if is_smoothed else None,
        # A path that is too long has no wrong loops for that.
        loops=judge_loops(result.attempts, result.keyframes, truth.enlarged(found.scale), config),
        links_nees=judge_links(result.links, result.keyframes, truth, config),
        tolerance_s=config.max_time_difference_s,
        coverage=coverage(result.odometry, truth, starts_s),
        rpe_interval_s=config.rpe_interval_s,
        truth_length_m=sum(path_length_m(each) for each in sessions(compared, starts_s)),
        truth=truth,
        doubts=(*found.doubts, *_doubts_about_scale(found.scale, result.camera.depth_scale)),
        unjudged=found.unjudged,
        helped_m=helped_m(result, truth, config.max_time_difference_s),
        before_more_loops=_error_of_some(result.more_loops.before, truth, config)
        if result.more_loops
        else None,
    )
    return _without_relative(drift) if found.unjudged else drift


def _doubts_about_scale(scale: float, depth_scale: float) -> tuple[str, ...]:
    if scale == 1.0:
        return ()
    return (
        f"the estimated path is {scale:.3g} times as long as the true one: if the ground truth is"
        f" in metres, {scale * depth_scale:.4g} depth units per metre would fit instead of"
        f" {depth_scale:g} (--input.depth-scale); errors are as the paths are, but loops were"
        " compared with a truth made as long",
    )


def _without_relative(drift: DriftReport) -> DriftReport:
    """Return the same without what depends on how the camera turned in truth."""

    def positions_alone(error: TrajectoryError) -> TrajectoryError:
        return replace(error, rpe_translation_m=np.nan, rpe_rotation_deg=np.nan)

    return replace(
        drift,
        odometry=positions_alone(drift.odometry),
        live=drift.live and positions_alone(drift.live),
        without_loops=positions_alone(drift.without_loops),
        corrected=positions_alone(drift.corrected),
        smoothed=drift.smoothed and positions_alone(drift.smoothed),
        loops=tuple(LoopTruth() for _ in drift.loops),
        links_nees=np.full_like(drift.links_nees, np.nan),
    )


def _error_of_some(
    estimate: Trajectory, truth: Trajectory, config: EvaluationConfig
) -> TrajectoryError | None:
    """Return the error of a trajectory that may lack frames, None where too few are left."""
    try:
        return trajectory_error(estimate, truth, config)
    except SlamError:
        return None


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")

# SPDX-License-Identifier: Apache-2.0
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.config import EvaluationConfig
from slam.evaluation.drift import compare_drift, trajectory_error
from slam.evaluation.trajectory import read_tum
from slam.geometry import se3
from slam.result import SlamResult
from slam.types import (
    Camera,
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    SlamError,
    Trajectory,
    Verification,
)

CONFIG = EvaluationConfig()
SHARED = Path(__file__).parents[4] / "shared" / "data"
FR1_DESK = Path(os.environ.get("LOOPCLOSE_DATA", SHARED)) / "rgbd_dataset_freiburg1_desk"


def moved(x=0.0, y=0.0, z=0.0, turn_deg=0.0):
    """A pose at x, y, z, turned about the z axis."""
    T = se3.exp(np.array([0.0, 0.0, np.deg2rad(turn_deg), 0.0, 0.0, 0.0]))
    T[:3, 3] = [x, y, z]
    return T


def along(stamps_s, poses):
    return Trajectory(np.asarray(stamps_s, dtype=np.float64), np.stack(poses))


def square(stamps_s=(0.0, 1.0, 2.0, 3.0)):
    return along(stamps_s, [moved(1.0, 0.0), moved(0.0, 1.0), moved(-1.0, 0.0), moved(0.0, -1.0)])


def test_a_moved_copy_of_the_truth_has_no_error():
    truth = square()
    T_world_truth = se3.exp(np.array([0.3, -0.5, 1.2, 4.0, 5.0, 6.0]))
    error = trajectory_error(
        Trajectory(truth.timestamps_s, T_world_truth @ truth.T_world_cam), truth, CONFIG
    )
    np.testing.assert_allclose(error.T_truth_world, se3.inverse(T_world_truth), atol=1e-12)
    assert error.ate_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert error.rpe_translation_m == pytest.approx(0.0, abs=1e-12)
    assert error.rpe_rotation_deg == pytest.approx(0.0, abs=1e-6)
    assert error.matched_share == 1.0


def test_figures_of_a_square_walked_in_too_large_steps():
    # Corners 1 m from the centre, estimated 1.5 m from it: each is off by 0.5 m whatever the
    # alignment, since none adjusts the scale. Sides are sqrt(2) and estimated as 1.5 sqrt(2).
    truth = square()
    estimate = square()
    estimate.T_world_cam[:, :3, 3] *= 1.5
    error = trajectory_error(estimate, truth, CONFIG)
    np.testing.assert_allclose(error.position_errors_m, 0.5)
    assert error.ate_rmse_m == pytest.approx(0.5)
    assert error.rpe_translation_m == pytest.approx(0.5 * math.sqrt(2.0))
    assert error.rpe_rotation_deg == pytest.approx(0.0, abs=1e-6)


def test_relative_error_is_the_root_mean_square_over_all_pairs_of_the_interval():
    # Steps of 1 m are estimated as 1 m, 1.3 m and 1 m with a turn of 9 degrees at the end.
    truth = along([0.0, 1.0, 2.0, 3.0], [moved(x) for x in (0.0, 1.0, 2.0, 3.0)])
    estimate = along(
        [0.0, 1.0, 2.0, 3.0], [moved(0.0), moved(1.0), moved(2.3), moved(3.3, turn_deg=9.0)]
    )
    error = trajectory_error(estimate, truth, CONFIG)
    assert error.rpe_translation_m == pytest.approx(0.3 / math.sqrt(3.0))
    assert error.rpe_rotation_deg == pytest.approx(9.0 / math.sqrt(3.0))
    over_two = trajectory_error(estimate, truth, EvaluationConfig(rpe_interval_s=2.0))
    assert over_two.rpe_translation_m == pytest.approx(0.3)  # 0-2 and 1-3
    assert over_two.rpe_rotation_deg == pytest.approx(9.0 / math.sqrt(2.0))


@pytest.mark.parametrize("interval_s", [10.0, 0.01], ids=["too long", "within the tolerance"])
def test_relative_error_over_an_interval_without_two_frames_is_unknown(interval_s):
    error = trajectory_error(square(), square(), EvaluationConfig(rpe_interval_s=interval_s))
    assert math.isnan(error.rpe_translation_m)
    assert math.isnan(error.rpe_rotation_deg)


def test_pairs_of_the_interval_must_be_that_far_apart_in_time():
    # 0 to 1.01 is near enough to 1 s, 1.01 to 2.1 and 2.1 to 3.2 are not.
    truth = along([0.0, 1.01, 2.1, 3.2], [moved(0.0), moved(1.0), moved(2.0), moved(3.0)])
    estimate = along(truth.timestamps_s, [moved(0.0), moved(1.2), moved(9.0), moved(5.0)])
    assert trajectory_error(estimate, truth, CONFIG).rpe_translation_m == pytest.approx(0.2)


def test_only_poses_with_truth_in_time_are_compared():
    stamps_s = [0.01, 1.01, 2.01, 3.01, 3.5]
    poses = [*square().T_world_cam, moved(100.0)]
    error = trajectory_error(along(stamps_s, poses), square(), CONFIG)
    np.testing.assert_array_equal(error.timestamps_s, stamps_s[:4])
    assert error.ate_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert error.matched_share == 0.8


def test_too_few_matches_name_gap_and_tolerance():
    with pytest.raises(SlamError, match=r"only 0 of 4 .* gap is 0\.25 s, the tolerance 0\.02 s"):
        trajectory_error(square([3.25, 4.25, 5.25, 6.25]), square(), CONFIG)
    with pytest.raises(SlamError, match=r"only 2 of 4 .* 3 are needed"):
        trajectory_error(square([2.0, 3.0, 4.0, 5.0]), square(), CONFIG)
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    with pytest.raises(SlamError, match="holds no poses"):
        trajectory_error(nothing, square(), CONFIG)


def seen(motion):
    mask = np.ones(3, dtype=np.bool_)
    return Verification(motion, np.zeros((3, 4)), mask, np.zeros((3, 3)))


def attempt(T_match_query):
    return LoopAttempt(1, 0, 0.9, None, RelativePose(T_match_query, np.eye(6)))


def result(truth, **fields):
    """Return a run whose trajectories are all right and whose frames are all keyframes."""
    keyframes = tuple(
        Keyframe(k, float(stamp_s), truth.T_world_cam[k], None, None)
        for k, stamp_s in enumerate(truth.timestamps_s)
    )
    same = dict.fromkeys(("odometry", "live", "without_loops", "trajectory"), truth)
    nothing = {"links": (), "attempts": (), "untracked_s": np.zeros(0), "warnings": ()}
    return SlamResult(
        camera=Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
        keyframes=keyframes,
        T_world_kf=truth.T_world_cam,
        similarities=np.zeros((0, 0), np.float32),
        min_similarity=0.5,
        stage_seconds={},
        **same | nothing | fields,
    )


def scaled(trajectory, factor):
    T_world_cam = trajectory.T_world_cam.copy()
    T_world_cam[:, :3, 3] *= factor
    return Trajectory(trajectory.timestamps_s, T_world_cam)


def test_each_trajectory_has_its_own_error():
    truth = square((0.0, 0.5, 1.0, 1.5))
    report = compare_drift(
        result(
            truth,
            odometry=scaled(truth, 1.5),
            live=scaled(truth, 1.4),
            without_loops=scaled(truth, 1.3),
            trajectory=scaled(truth, 1.2),
            attempts=(attempt(np.eye(4)),),
        ),
        truth,
        CONFIG,
    )
    assert report.odometry.ate_rmse_m == pytest.approx(0.5)
    assert report.live.ate_rmse_m == pytest.approx(0.4)
    assert report.without_loops.ate_rmse_m == pytest.approx(0.3)
    assert report.corrected.ate_rmse_m == pytest.approx(0.2)
    assert report.smoothed is None
    assert report.truth_length_m == pytest.approx(3.0 * math.sqrt(2.0))
    assert report.coverage == 1.0
    assert (report.tolerance_s, report.rpe_interval_s) == (0.02, 1.0)
    assert [loop.is_false for loop in report.loops] == [True]


def test_what_is_smoothed_stands_apart_from_what_was_tracked():
    truth = square()
    smoothed = result(truth, trajectory=scaled(truth, 1.2), unsmoothed=scaled(truth, 1.1))
    report = compare_drift(smoothed, truth, CONFIG)
    assert report.corrected.ate_rmse_m == pytest.approx(0.1)
    assert report.smoothed.ate_rmse_m == pytest.approx(0.2)


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_live_frames_have_no_error(count):
    truth = square()
    few = Trajectory(truth.timestamps_s[:count], truth.T_world_cam[:count])
    report = compare_drift(result(truth, live=few), truth, CONFIG)
    assert report.live is None
    assert report.corrected.ate_rmse_m == pytest.approx(0.0, abs=1e-12)


def test_medians_are_of_links_and_accepted_loops_that_truth_covers():
    truth = square((0.0, 1.0, 2.0, 9.0))
    known = Trajectory(truth.timestamps_s[:3], truth.T_world_cam[:3])
    T_0_1 = se3.inverse(truth.T_world_cam[0]) @ truth.T_world_cam[1]

    def off_by(metres):
        return RelativePose(T_0_1 @ moved(metres), 100.0 * np.eye(6))

    outvoted = LoopAttempt(1, 0, 0.9, None, Rejection(RejectionReason.OUTVOTED, 0.0, 0.5))
    run = result(
        truth,
        links=(Link(0, 1, off_by(0.1)), Link(0, 1, off_by(0.3)), Link(0, 3, off_by(9.0))),
        attempts=(
            LoopAttempt(1, 0, 0.9, None, off_by(0.2)),
            replace(outvoted, verification=seen(off_by(2.0))),
            LoopAttempt(3, 0, 0.9, None, off_by(9.0)),
        ),
    )
    report = compare_drift(run, known, CONFIG)
    np.testing.assert_allclose(report.links_nees, [1.0, 9.0, np.nan])
    assert report.median_links_nees == pytest.approx(5.0)
    assert report.median_loops_nees == pytest.approx(4.0)
    nothing = compare_drift(result(truth), truth, CONFIG)
    assert math.isnan(nothing.median_links_nees) and math.isnan(nothing.median_loops_nees)


def with_right_loops(path):
    """A run that has a right loop from each pose to the one 20 before."""
    loops = [
        LoopAttempt(k, k - 20, 0.9, None, RelativePose(T_match_query, np.eye(6)))
        for k in range(20, len(path))
        for T_match_query in [se3.inverse(path.T_world_cam[k - 20]) @ path.T_world_cam[k]]
    ]
    links = (Link(0, 20, loops[0].motion),)
    return result(path, attempts=tuple(loops), links=links)


def hand_held():
    stamps_s = np.arange(0.0, 20.0, 0.2)
    rates = np.array([0.9, 0.7, 1.3, 0.5, 0.8, 0.3])
    return Trajectory(stamps_s, se3.exp(0.7 * np.sin(np.outer(stamps_s, rates) + np.arange(6.0))))


def test_loops_of_a_perfect_run_are_not_false_by_the_truth_of_a_body():
    path = hand_held()
    T_cam_body = se3.exp(np.array([1.2, -1.2, 1.2, 0.1, 0.05, -0.2]))
    truth = Trajectory(path.timestamps_s, path.T_world_cam @ T_cam_body)
    report = compare_drift(with_right_loops(path), truth, CONFIG)
    assert [loop.is_false for loop in report.loops] == [False] * 80
    assert report.corrected.ate_rmse_m < 1e-6
    assert report.corrected.rpe_rotation_deg < 1e-3
    assert "it is of a body" in report.doubts[0]
    np.testing.assert_allclose(report.truth.T_world_cam, path.T_world_cam, atol=1e-6)


def test_positions_alone_have_an_ate_and_nothing_else():
    path = hand_held()
    poses = path.T_world_cam.copy()
    poses[:, :3, :3] = np.eye(3)
    report = compare_drift(with_right_loops(path), along(path.timestamps_s, poses), CONFIG)
    assert report.corrected.ate_rmse_m < 1e-9
    for error in (report.odometry, report.live, report.without_loops, report.corrected):
        assert math.isnan(error.rpe_translation_m) and math.isnan(error.rpe_rotation_deg)
    assert {loop.is_false for loop in report.loops} == {None}
    assert math.isnan(report.median_links_nees) and math.isnan(report.median_loops_nees)
    assert "positions alone" in report.unjudged


def test_a_wrong_depth_scale_is_named_and_makes_no_loop_false():
    path = hand_held()
    report = compare_drift(with_right_loops(path), scaled(path, 1.0 / 1.31), CONFIG)
    assert [loop.is_false for loop in report.loops] == [False] * 80
    assert report.corrected.ate_rmse_m > 0.1
    (doubt,) = report.doubts
    assert "1.31 times as long as the true one" in doubt
    assert "6550 depth units per metre would fit instead of 5000 (--input.depth-scale)" in doubt


def test_figures_agree_with_evo():
    metrics = pytest.importorskip("evo.core.metrics", reason="evo, the oracle, is not installed")
    evo_sync = pytest.importorskip("evo.core.sync")
    evo_trajectory = pytest.importorskip("evo.core.trajectory")
    if not (FR1_DESK / "groundtruth.txt").is_file():
        pytest.skip(f"no fr1_desk ground truth at {FR1_DESK}")
    poses = read_tum(FR1_DESK / "groundtruth.txt").T_world_cam[:1500]
    truth = Trajectory(1000.0 + 0.01 * np.arange(len(poses)), poses)
    rng = np.random.default_rng(4)
    noise = [se3.exp(rng.normal(0.0, 0.02, 6)) for _ in poses[::3]]
    estimate = Trajectory(truth.timestamps_s[::3] + 0.003, poses[::3] @ np.stack(noise))
    ours = trajectory_error(estimate, truth, EvaluationConfig(rpe_interval_s=0.9))

    def evo_path(trajectory):
        return evo_trajectory.PoseTrajectory3D(
            poses_se3=list(trajectory.T_world_cam), timestamps=trajectory.timestamps_s
        )

    pair = evo_sync.associate_trajectories(evo_path(truth), evo_path(estimate), max_diff=0.02)
    assert pair[0].num_poses == len(ours.timestamps_s) == len(estimate)
    pair[1].align(pair[0])
    relation = metrics.PoseRelation

    def rmse(metric):
        metric.process_data(pair)
        return metric.get_statistic(metrics.StatisticsType.rmse)

    def rpe(part):
        return metrics.RPE(part, delta=30, delta_unit=metrics.Unit.frames, all_pairs=True)

    assert ours.ate_rmse_m == pytest.approx(rmse(metrics.APE(relation.translation_part)), rel=1e-9)
    assert ours.rpe_translation_m == pytest.approx(rmse(rpe(relation.translation_part)), rel=1e-9)
    angle = relation.rotation_angle_deg
    assert ours.rpe_rotation_deg == pytest.approx(rmse(rpe(angle)), rel=1e-9)


def test_the_way_between_sessions_is_no_part_of_the_path():
    stamps_s = [0.0, 1.0, 100.0, 101.0]
    path = along(stamps_s, [moved(x) for x in (0.0, 1.0, 50.0, 51.0)])
    for starts_s, length_m in (((), 51.0), ((100.0,), 2.0)):
        run = result(path, session_starts_s=np.array(starts_s))
        report = compare_drift(run, path, CONFIG)
        assert report.truth_length_m == pytest.approx(length_m)
        early = Trajectory(path.timestamps_s - 0.002, path.T_world_cam)
        assert compare_drift(run, early, CONFIG).truth_length_m == pytest.approx(length_m)

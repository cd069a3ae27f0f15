# SPDX-License-Identifier: Apache-2.0
import errno
import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from placerec import certificate
from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation.calibration import Scenes, calibrate
from placerec.recognizers.gradients import GradientRecognizer
from slam.config import Config, EvaluationConfig, KeyframesConfig, LoopConfig, MotionConfig
from slam.evaluation.drift import compare_drift, trajectory_error
from slam.geometry import se3
from slam.mapping import map_adjustment
from slam.pose_graph import solve
from slam.system import Slam
from slam.tracking.odometry import TrackedFrame
from slam.types import Camera, Rejection, RelativePose, SlamError, Trajectory

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


def run(frames, config=None, recognizer=None):
    slam = Slam(CAMERA, recognizer or GradientRecognizer(), config)
    for frame in frames:
        slam.process(frame)
    return slam.finish()


@pytest.fixture
def two_places():
    """Return a dataset of two images each of two places that look nothing alike."""
    everyone, places = np.arange(4), np.array([0, 0, 1, 1])
    dataset = PlaceDataset(
        name="two places",
        paths=tuple(Path(f"{i}.png") for i in everyone),
        queries=everyone,
        references=everyone,
        same_place=places[:, None] == places,
        comparable=~np.eye(4, dtype=bool),
    )
    return dataset, np.eye(2, dtype=np.float32)[places]


def black(frame):
    return replace(frame, rgb=np.zeros_like(frame.rgb))


@pytest.fixture(scope="module")
def result(room_run):
    return room_run


@pytest.fixture(scope="module")
def drifting(frames, T_first_cam):
    """Return every fourth frame and its pose by an odometry from elsewhere that drifts."""
    chosen = list(range(0, len(frames), 4))
    step = se3.exp(np.array([0.0, 0.004, 0.0, 0.008, 0.0, 0.008]))
    T_odom_cam = [np.eye(4)]
    for before, after in pairwise(chosen):
        T_before_after = se3.inverse(T_first_cam[before]) @ T_first_cam[after]
        T_odom_cam.append(T_odom_cam[-1] @ T_before_after @ step)
    return [frames[i] for i in chosen], T_odom_cam


def add_all(drifting, config=None):
    slam = Slam(CAMERA, GradientRecognizer(), config)
    attempts = [slam.add_keyframe(frame, T) for frame, T in zip(*drifting, strict=True)]
    return slam.finish(), attempts


@pytest.fixture(scope="module")
def added(drifting):
    """Return the result with the drifting odometry, and what each keyframe was told of loops."""
    return add_all(drifting)


@pytest.fixture(scope="module")
def again(frames):
    """Return a second result of the whole recording, and the graphs that were solved for it."""
    graphs = []

    def spied(graph, probability):
        graphs.append(graph)
        return solve(graph, probability)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slam.pose_graph.solve", spied)
        return run(frames), graphs


def test_every_tracked_frame_is_in_both_trajectories(result, frames):
    times_s = [frame.timestamp_s for frame in frames]
    for trajectory in (result.odometry, result.trajectory):
        np.testing.assert_array_equal(trajectory.timestamps_s, times_s)
        assert trajectory.T_world_cam.shape == (60, 4, 4)
        np.testing.assert_allclose(trajectory.T_world_cam[0], np.eye(4), atol=1e-9)
        R = trajectory.T_world_cam[:, :3, :3]
        unit = np.tile(np.eye(3), (60, 1, 1))
        np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), unit, atol=1e-9)
    assert len(result.untracked_s) == 0 and result.camera == CAMERA


def test_the_corrected_path_is_near_the_truth(result, sequence):
    truth, config = sequence.ground_truth, EvaluationConfig()
    drift = compare_drift(result, truth, config)
    assert drift.odometry.ate_rmse_m < 0.03 and drift.corrected.ate_rmse_m < 0.02
    assert not any(loop.is_false for loop in drift.loops)


def test_loops_that_agree_with_the_odometry_are_believed(result):
    accepted = [attempt for attempt in result.attempts if isinstance(attempt.outcome, RelativePose)]
    assert len(accepted) > 1
    assert min(attempt.weight for attempt in accepted) > 0.9
    assert result.warnings == ()


def test_keyframes_ride_on_themselves(result):
    index_of = {time_s: i for i, time_s in enumerate(result.trajectory.timestamps_s)}
    at_keyframes = [index_of[keyframe.timestamp_s] for keyframe in result.keyframes]
    corrected = result.trajectory.T_world_cam[at_keyframes]
    np.testing.assert_allclose(corrected, result.T_world_kf, atol=1e-9)


def test_each_trajectory_is_what_it_says(frames):
    slam, tracked, corrections = Slam(CAMERA, GradientRecognizer()), [], []
    for frame in frames:
        tracked.append(slam.process(frame))
        slam.settle()
        corrections.append(slam.T_world_odom())
    result = slam.finish()
    T_odom_cam = np.array([each.T_odom_cam for each in tracked])
    np.testing.assert_array_equal(result.odometry.T_world_cam, T_odom_cam)
    live = np.array(corrections) @ T_odom_cam
    np.testing.assert_allclose(result.live.T_world_cam, live, atol=1e-9)
    T_world_cam = np.array([result.T_world_kf[e.keyframe_id] @ e.T_kf_cam for e in tracked])
    starts = [n for n, each in enumerate(tracked) if each.new_keyframe]
    np.testing.assert_allclose(
        result.trajectory.T_world_cam[starts], T_world_cam[starts], atol=1e-9
    )
    for start, end in pairwise(starts):  # what is in between, seen from before and from behind
        (tie,) = [each for each in tracked[end].links if each.ref_id == tracked[start].keyframe_id]
        T_end_start = se3.inverse(tie.motion.T_ref_query)
        for n in range(start + 1, end):
            behind = T_world_cam[end] @ T_end_start @ tracked[n].T_kf_cam
            share = (frames[n].timestamp_s - frames[start].timestamp_s) / (
                frames[end].timestamp_s - frames[start].timestamp_s
            )
            mixed_m = (1.0 - share) * T_world_cam[n, :3, 3] + share * behind[:3, 3]
            np.testing.assert_allclose(result.trajectory.T_world_cam[n, :3, 3], mixed_m, atol=1e-4)
    last = slice(starts[-1], None)
    np.testing.assert_allclose(result.trajectory.T_world_cam[last], T_world_cam[last], atol=1e-9)
    unlooped = run(frames, Config(loop=LoopConfig(min_similarity=1.0)))
    without_loops = result.without_loops.T_world_cam
    np.testing.assert_allclose(without_loops, unlooped.trajectory.T_world_cam, atol=1e-9)
    assert not np.allclose(without_loops, result.trajectory.T_world_cam, atol=1e-4)
    assert not np.allclose(live, T_odom_cam, atol=1e-4)


def test_poses_from_elsewhere_are_not_smoothed(drifting, monkeypatch):
    monkeypatch.delattr("slam.system.finishing.smoothed")
    result, _ = add_all(drifting, Config(motion=MotionConfig(smooth=True)))
    np.testing.assert_array_equal(result.odometry.T_world_cam, drifting[1])
    np.testing.assert_allclose(result.trajectory.T_world_cam, result.T_world_kf, atol=1e-9)


def test_a_jump_of_an_odometry_from_elsewhere_is_told_and_bridged(frames, T_first_cam, sequence):
    T_odom_cam = T_first_cam[:24].copy()
    T_odom_cam[14:, 0, 3] += 1.0
    result, _ = add_all((frames[:24], T_odom_cam))
    start_s, end_s = frames[13].timestamp_s, frames[14].timestamp_s
    (warning,) = [each for each in result.warnings if "contradict" in each]
    assert f"from {start_s:.2f} to {end_s:.2f} s" in warning
    error = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    assert error.ate_rmse_m < 0.02


def test_steps_that_no_camera_makes_are_warned_of(frames, monkeypatch):
    monkeypatch.setattr("slam.system.finishing.impossible_steps", lambda *_: ("a leap",))
    assert "a leap" in run(frames[:3]).warnings


def test_poses_from_elsewhere_have_nothing_unsmoothed_beside_them(added):
    elsewhere, _ = added
    assert elsewhere.unsmoothed is None and elsewhere.corrected is elsewhere.trajectory


def test_links_tie_every_keyframe_and_attempts_look_back(result):
    count = len(result.keyframes)
    assert {link.query_id for link in result.links} == set(range(1, count))
    assert all(link.ref_id < link.query_id for link in result.links)
    assert result.attempts and all(each.match_id < each.query_id for each in result.attempts)
    for attempt in result.attempts:
        assert (attempt.weight is not None) == isinstance(attempt.outcome, RelativePose)
    assert result.similarities.shape == (count, count)
    assert result.min_similarity == GradientRecognizer.min_similarity
    assert result.threshold.min_similarity == result.min_similarity
    assert result.threshold.one_place_pairs > 0


def test_all_links_and_accepted_loops_come_into_the_graph(again):
    result, (graph, without) = again
    assert without.links == graph.links and not without.loops
    assert tuple(graph.links) == result.links
    assert [(key, loop.ref_id, loop.query_id) for key, loop in graph.loops.items()] == [
        (key, attempt.match_id, attempt.query_id)
        for key, attempt in enumerate(result.attempts)
        if isinstance(attempt.outcome, RelativePose)
    ]
    assert len(graph.loops) > 1


def test_stages_are_in_the_order_of_the_pipeline(result):
    assert list(result.stage_seconds) == [
        "track",
        "describe",
        "close loops",
        "correct",
        "graph",
        "adjust",
    ]
    assert all(seconds > 0.0 for seconds in result.stage_seconds.values())
    assert result.elapsed_s >= max(result.stage_seconds.values())
    assert 0.0 <= result.compiling_s < result.elapsed_s


def test_two_runs_give_the_same_bits(again, result):
    again, _ = again
    np.testing.assert_array_equal(again.trajectory.T_world_cam, result.trajectory.T_world_cam)
    np.testing.assert_array_equal(again.similarities, result.similarities)
    for one, other in zip(again.attempts, result.attempts, strict=True):
        assert (one.query_id, one.match_id, one.weight) == (
            other.query_id,
            other.match_id,
            other.weight,
        )
        assert one.similarity == other.similarity


def test_a_frame_that_cannot_be_tracked_is_counted_and_warned_of(frames):
    slam = Slam(CAMERA, GradientRecognizer())
    outcomes = [
        slam.process(black(frame) if i in (4, 5) else frame) for i, frame in enumerate(frames[:8])
    ]
    kinds = [Rejection if i in (4, 5) else TrackedFrame for i in range(8)]
    assert [type(outcome) for outcome in outcomes] == kinds
    result = slam.finish()
    assert result.untracked_s.tolist() == [frames[4].timestamp_s, frames[5].timestamp_s]
    assert len(result.trajectory) == len(result.odometry) == 6
    (warning,) = result.warnings
    assert warning.startswith("2 of 8 frames could not be tracked")
    assert f"{frames[4].timestamp_s:.3f}" in warning


def test_nothing_but_black_frames_is_an_error_that_says_what_to_do(frames):
    slam = Slam(CAMERA, GradientRecognizer())
    for finish in (slam.finish, lambda: run([black(frame) for frame in frames[:3]])):
        with pytest.raises(SlamError, match=r"no frame could be tracked: .*odometry\.min-inliers"):
            finish()
    assert not slam.has_keyframes


def test_one_frame_is_a_run(frames):
    result = run(frames[:1])
    assert len(result.trajectory) == len(result.keyframes) == 1
    assert result.attempts == result.links == result.warnings == ()


def test_finish_may_be_asked_for_more_than_once(frames):
    slam = Slam(CAMERA, GradientRecognizer())
    for frame in frames[:10]:
        slam.process(frame)
    first = slam.finish()
    for frame in frames[10:20]:
        slam.process(frame)
    second = slam.finish()
    assert len(first.trajectory) == 10 and len(second.trajectory) == 20


def test_no_correction_makes_a_run_worse(result, sequence, assert_no_correction_hurts):
    drift = compare_drift(result, sequence.ground_truth, EvaluationConfig())
    # Adjusting the map moves 13 keyframes along directions that their images hardly hold: by chance
    # it adds 0.21 mm to 7.12 here, and how the processor rounds moves that by some hundredths.
    assert_no_correction_hurts(drift, most_m=3e-4)


def test_a_run_too_long_to_be_adjusted_has_the_poses_of_the_graph_and_says_so(
    frames, result, sequence, monkeypatch, assert_no_correction_hurts
):
    monkeypatch.setattr(map_adjustment, "MOST_KEYFRAMES", len(result.keyframes) - 1)
    longer = run(frames)
    (warning,) = longer.warnings
    assert warning.startswith(f"{len(result.keyframes)} keyframes are more than")
    assert "adjust" not in longer.stage_seconds
    np.testing.assert_allclose(longer.T_world_kf, result.T_world_kf, atol=0.03)
    assert (longer.T_world_kf != result.T_world_kf).any()
    assert_no_correction_hurts(compare_drift(longer, sequence.ground_truth, EvaluationConfig()))


def test_poses_from_elsewhere_are_corrected_by_loops(added, drifting, sequence):
    result, attempts = added
    assert len(result.keyframes) == len(drifting[0]) == len(result.trajectory)
    np.testing.assert_array_equal(result.odometry.T_world_cam, drifting[1])
    before = trajectory_error(result.odometry, sequence.ground_truth, EvaluationConfig())
    after = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    assert before.ate_rmse_m > 0.03
    assert after.ate_rmse_m < 0.5 * before.ate_rmse_m
    assert sum(isinstance(each.outcome, RelativePose) for each in result.attempts) > 1
    assert [len(each) for each in attempts] == [
        sum(each.query_id == number for each in result.attempts) for number in range(len(attempts))
    ]
    assert all(attempt.weight is None for each in attempts for attempt in each)


def test_without_candidates_images_alone_correct_poses_from_elsewhere(drifting, sequence):
    result, attempts = add_all(drifting, Config(loop=LoopConfig(min_gap=1000)))
    assert not result.attempts and not any(attempts)
    before = trajectory_error(result.odometry, sequence.ground_truth, EvaluationConfig())
    after = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    assert after.ate_rmse_m < 0.5 * before.ate_rmse_m


def test_the_map_lies_where_an_odometry_that_begins_later_begins(frames, T_first_cam):
    slam, T_any_odom = Slam(CAMERA, GradientRecognizer()), se3.exp(np.full(6, 0.5))
    for i, (frame, T) in enumerate(zip(frames[:40], T_first_cam, strict=False)):
        slam.process(frame, T_any_odom @ T if i >= 20 else None)
    slam.settle()
    shift = se3.log(slam.T_map_odom())
    assert np.linalg.norm(shift[:3]) < 0.03 and np.linalg.norm(shift[3:]) < 0.03


def test_what_an_odometry_tells_of_its_own_noise_is_respected(drifting):
    slam, told = Slam(CAMERA, GradientRecognizer()), np.diag([1e-4] * 3 + [4e-4] * 3)
    for frame, T_odom_cam in zip(*drifting, strict=True):
        slam.process(frame, T_odom_cam, told)
    step, *_ = slam.finish().given.steps
    np.testing.assert_allclose(np.linalg.inv(step.motion.information), told)
    T_first_second = se3.inverse(drifting[1][step.ref_id]) @ drifting[1][step.query_id]
    np.testing.assert_allclose(step.motion.T_ref_query, T_first_second, atol=1e-12)


def test_poses_between_images_are_corrected_too(frames, T_first_cam, sequence):
    """Of every image but each third one there is a pose alone."""
    slam, step = (
        Slam(CAMERA, GradientRecognizer()),
        se3.exp(np.array([0, 0.001, 0, 0.002, 0, 0.002])),
    )
    T_odom_cam = [np.eye(4)]
    for before, after in pairwise(T_first_cam):
        T_odom_cam.append(T_odom_cam[-1] @ se3.inverse(before) @ after @ step)
    for i, (frame, T) in enumerate(zip(frames, T_odom_cam, strict=True)):
        if i % 3:
            slam.add_pose(frame.timestamp_s, T)
        else:
            slam.process(frame, T)
    given = slam.finish().given
    np.testing.assert_array_equal(given.given.T_world_cam, T_odom_cam)
    assert given.corrected.timestamps_s.tolist() == [frame.timestamp_s for frame in frames]
    before, after = (
        trajectory_error(each, sequence.ground_truth, EvaluationConfig()).ate_rmse_m
        for each in (given.given, given.corrected)
    )
    assert after < 0.5 * before


def test_an_odometry_made_from_the_same_images_does_no_harm(frames, room_run, sequence):
    slam = Slam(CAMERA, GradientRecognizer())
    for frame, T in zip(frames, room_run.odometry.T_world_cam, strict=True):
        slam.process(frame, T)
    result = slam.finish()
    assert "cannot tell it from the truth" not in result.given.verdict
    after, odometry = (
        trajectory_error(each, sequence.ground_truth, EvaluationConfig()).ate_rmse_m
        for each in (result.trajectory, room_run.odometry)
    )
    assert after < min(odometry, 0.02)


def test_the_truth_given_as_an_odometry_stays_the_truth(frames, T_first_cam, sequence):
    slam = Slam(CAMERA, GradientRecognizer())
    for frame, T in zip(frames, T_first_cam, strict=True):
        slam.process(frame, T)
    result = slam.finish()
    assert "cannot tell it from the truth" in result.given.verdict
    live = trajectory_error(result.live, sequence.ground_truth, EvaluationConfig())
    assert live.ate_rmse_m < 2e-3
    for trajectory in (result.without_loops, result.trajectory, result.given.corrected):
        error = trajectory_error(trajectory, sequence.ground_truth, EvaluationConfig())
        assert error.ate_rmse_m < 1e-3


def test_where_the_images_show_nothing_the_odometry_leads_on(frames, T_first_cam, sequence):
    """Half of a lap is dark; what is seen then was never seen before."""
    slam = Slam(CAMERA, GradientRecognizer(), Config(loop=LoopConfig(min_gap=1000)))
    for i, (frame, T) in enumerate(zip(frames, T_first_cam, strict=True)):
        slam.process(black(frame) if 15 <= i < 32 else frame, T)
    result = slam.finish()
    assert np.isfinite(result.T_world_kf).all() and not len(result.unjoined_s)
    assert len(result.given.corrected) == 60
    for trajectory in (result.trajectory, result.given.corrected):
        error = trajectory_error(trajectory, sequence.ground_truth, EvaluationConfig())
        assert error.ate_rmse_m < 0.01


def test_poses_that_have_nothing_to_do_with_the_images_are_not_used(frames, room_run):
    slam, rng = Slam(CAMERA, GradientRecognizer()), np.random.default_rng(0)
    for frame in frames:
        slam.process(frame, se3.exp(rng.normal(size=6)))
    result = slam.finish()
    assert not result.given.fits
    np.testing.assert_allclose(result.T_world_kf, room_run.T_world_kf, atol=1e-3)


def test_a_start_away_from_the_origin_is_fine(added, drifting):
    T_map_odom = se3.exp(np.array([0.3, 0.2, 0.1, 5.0, 6.0, 7.0]))
    moved = drifting[0], [T_map_odom @ T for T in drifting[1]]
    here, there = added[0], add_all(moved)[0]
    # The world is the first keyframe's camera, wherever the odometry began.
    np.testing.assert_allclose(there.T_world_kf, here.T_world_kf, atol=1e-6)


def test_the_pose_given_may_be_changed_afterwards(frames):
    slam = Slam(CAMERA, GradientRecognizer())
    T_odom_cam = np.eye(4)
    slam.add_keyframe(frames[0], T_odom_cam)
    T_odom_cam[0, 3] = 0.1
    slam.add_keyframe(frames[1], T_odom_cam)
    positions = slam.finish().odometry.T_world_cam[:, 0, 3]
    assert positions.tolist() == [0.0, 0.1]


def test_the_correction_so_far_takes_poses_from_elsewhere_to_the_map(drifting):
    T_any_odom = se3.exp(np.array([0.3, 0.2, 0.1, 5.0, 6.0, 7.0]))
    slam = Slam(CAMERA, GradientRecognizer())
    with pytest.raises(SlamError, match="no frame with a pose"):
        slam.T_map_odom()
    for frame, T_odom_cam in zip(*drifting, strict=True):
        slam.process(frame, T_any_odom @ T_odom_cam)
    slam.settle()
    T_map_cam = slam.T_map_odom() @ T_any_odom @ drifting[1][-1]
    # The map lies where the odometry began.
    T_world_cam = se3.inverse(T_any_odom) @ T_map_cam
    np.testing.assert_allclose(T_world_cam, slam.finish().trajectory.T_world_cam[-1], atol=0.02)
    assert np.linalg.norm(T_world_cam[:3, 3] - drifting[1][-1][:3, 3]) > 0.05


def spoiled(**entries):
    T = np.eye(4)
    for name, value in entries.items():
        T[int(name[1]), int(name[2])] = value
    return T


@pytest.mark.parametrize(
    "T_odom_cam",
    [
        spoiled(_00=2.0),
        spoiled(_00=-1.0),
        spoiled(_01=0.1),
        spoiled(_03=np.nan),
        spoiled(_11=np.nan),
        spoiled(_13=np.inf),
        spoiled(_30=1.0),
        spoiled(_33=2.0),
        np.eye(3),
        np.eye(4)[:3],
        np.eye(4)[None],
        np.zeros(7),
        np.float64(1.0),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused(frames, T_odom_cam):
    slam = Slam(CAMERA, GradientRecognizer())
    with pytest.raises(SlamError, match=r"not a rigid \(4, 4\) transform") as error:
        slam.add_keyframe(frames[0], T_odom_cam)
    assert "\n" not in str(error.value)
    assert not slam.has_keyframes


@pytest.mark.parametrize("step_s", [0.0, -0.1, np.nan])
def test_time_has_to_go_on(frames, step_s):
    later = replace(frames[1], timestamp_s=frames[0].timestamp_s + step_s)
    slam = Slam(CAMERA, GradientRecognizer())
    slam.add_keyframe(frames[0], np.eye(4))
    with pytest.raises(SlamError, match="order of time"):
        slam.add_keyframe(later, np.eye(4))
    slam = Slam(CAMERA, GradientRecognizer())
    slam.process(frames[0])
    with pytest.raises(SlamError, match="order of time"):
        slam.process(later)
    assert len(slam.finish().trajectory) == 1


def test_a_frame_of_another_size_is_refused(frames):
    small = replace(frames[1], rgb=frames[1].rgb[:-2], depth_m=frames[1].depth_m[:-2])
    torn = replace(frames[1], depth_m=frames[1].depth_m[:, :-2])
    grey = replace(frames[1], rgb=frames[1].rgb[:, :, 0])
    for spoiled_frame in (small, torn, grey):
        slam = Slam(CAMERA, GradientRecognizer())
        for take in (slam.process, lambda frame, to=slam: to.add_keyframe(frame, np.eye(4))):
            with pytest.raises(SlamError, match="but the camera makes") as error:
                take(spoiled_frame)
            assert "\n" not in str(error.value)


def test_colours_that_are_not_bytes_are_refused(frames):
    floats = replace(frames[0], rgb=frames[0].rgb / 255.0)
    with pytest.raises(SlamError, match="float64 colours, not uint8"):
        Slam(CAMERA, GradientRecognizer()).process(floats)


def test_frames_with_and_without_a_pose_may_follow_one_another(frames):
    slam = Slam(CAMERA, GradientRecognizer())
    slam.process(frames[0])
    slam.add_keyframe(frames[1], np.eye(4))
    slam.process(frames[2])
    result = slam.finish()
    assert len(result.trajectory) == 3 and len(result.given.given) == 1


def test_a_refused_frame_may_be_given_again_with_a_better_pose(frames):
    slam = Slam(CAMERA, GradientRecognizer())
    with pytest.raises(SlamError, match="not a rigid"):
        slam.add_keyframe(frames[0], np.zeros((4, 4)))
    slam.add_keyframe(frames[0], np.eye(4))
    assert len(slam.finish().keyframes) == 1


class Failing(GradientRecognizer):
    """Works for some keyframes, and then no more."""

    def __init__(self, good):
        self.good = good

    def embed(self, image):
        self.good -= 1
        return super().embed(image) if self.good >= 0 else np.full(496, np.nan)


def test_what_was_found_before_a_recognizer_failed_is_kept(frames):
    slam = Slam(CAMERA, Failing(4))
    with pytest.raises(RecognizerError, match="NaN"):
        for frame in frames:
            slam.process(frame)
    result = slam.finish()
    assert len(result.keyframes) == 4 == len(result.similarities)
    assert result.T_world_kf.shape == (4, 4, 4)
    assert len(result.trajectory) == len(result.odometry) > 4
    assert result.trajectory.timestamps_s[-1] >= result.keyframes[-1].timestamp_s


class Certified(GradientRecognizer):
    """The same, but calibrated in a world where no two places look alike."""

    def __init__(self, dataset, embeddings):
        scenes = Scenes(dataset.name, [dataset], [embeddings])
        self.certificate = calibrate("certified", self, [scenes])


def test_a_run_says_what_its_recognizer_was_calibrated_on_and_doubts_it(
    frames, result, monkeypatch, two_places
):
    monkeypatch.setattr(certificate, "_FEW_PAIRS", 1)
    recognizer = Certified(*two_places)
    certified = run(frames, recognizer=recognizer)
    assert certified.calibration.certificate is recognizer.certificate
    live = certified.calibration.live_similarities
    assert len(live) and np.isin(live, certified.similarities).all()
    assert result.calibration is None
    (warning,) = set(certified.warnings) - set(result.warnings)
    assert "calibrated on two places" in warning
    np.testing.assert_array_equal(certified.T_world_kf, result.T_world_kf)


def torn_frames(frames):
    return [*frames[:10], *(black(frame) for frame in frames[10:24]), *frames[24:]]


@pytest.fixture(scope="module")
def torn(frames):
    """Return a run whose camera was lost for a third of the way there, and then went back."""
    return run(torn_frames(frames))


def test_frames_are_smoothed_if_asked_between_the_breaks_and_nothing_else_changes(
    torn, frames, monkeypatch
):
    breaks_s = []

    def moved(trajectory, its_breaks_s):
        breaks_s.append(its_breaks_s)
        return Trajectory(trajectory.timestamps_s, trajectory.T_world_cam + 0.01)

    monkeypatch.setattr("slam.system.finishing.smoothed", moved)
    config = Config(motion=MotionConfig(smooth=True))
    again = run(torn_frames(frames), config)
    smooth, rough = again.trajectory, torn.trajectory
    np.testing.assert_array_equal(smooth.T_world_cam, rough.T_world_cam + 0.01)
    for name in ("odometry", "live", "without_loops", "corrected"):
        rough = getattr(torn, name)
        np.testing.assert_array_equal(getattr(again, name).T_world_cam, rough.T_world_cam)
    assert breaks_s == [[frames[24].timestamp_s]]
    # All else is the same to the bit, a second time.
    np.testing.assert_array_equal(again.T_world_kf, torn.T_world_kf)
    assert [each.weight for each in again.attempts] == [each.weight for each in torn.attempts]


def test_the_two_sides_of_a_loss_are_joined_where_a_place_is_seen_again(torn, frames, sequence):
    assert {keyframe.segment for keyframe in torn.keyframes} == {0, 1}
    assert np.isfinite(torn.T_world_kf).all()
    times_s = [frame.timestamp_s for frame in (*frames[:10], *frames[24:])]
    for trajectory in (torn.odometry, torn.trajectory):
        np.testing.assert_array_equal(trajectory.timestamps_s, times_s)
    assert len(torn.untracked_s) == 14 and len(torn.unjoined_s) == 0
    (warning,) = torn.warnings
    assert warning.startswith("14 of 60 frames could not be tracked")
    error = trajectory_error(torn.trajectory, sequence.ground_truth, EvaluationConfig())
    assert error.position_errors_m.max() < 0.05


def test_loops_between_segments_are_loops_like_others(torn, sequence):
    segment_of = [keyframe.segment for keyframe in torn.keyframes]
    across = [
        each for each in torn.attempts if segment_of[each.match_id] != segment_of[each.query_id]
    ]
    assert sum((each.weight or 0.0) > 0.9 for each in across) >= 2
    ties = [link for link in torn.links if segment_of[link.ref_id] != segment_of[link.query_id]]
    assert [segment_of.index(1)] == [tie.query_id for tie in ties]
    assert np.trace(ties[0].motion.information) < 10.0


def test_a_torn_odometry_is_tied_by_one_motion(torn, sequence):
    index_of = {time_s: i for i, time_s in enumerate(torn.odometry.timestamps_s)}
    at_keyframes = [index_of[keyframe.timestamp_s] for keyframe in torn.keyframes]
    np.testing.assert_allclose(
        torn.odometry.T_world_cam[at_keyframes],
        [keyframe.T_odom_cam for keyframe in torn.keyframes],
        atol=0.02,
    )
    error = trajectory_error(torn.odometry, sequence.ground_truth, EvaluationConfig())
    assert error.ate_rmse_m < 0.05


def test_a_part_that_nothing_joins_is_told_and_not_made_up(frames):
    result = run([*frames[:6], *frames[24:34]])
    is_first = [keyframe.segment == 0 for keyframe in result.keyframes]
    assert 0 < sum(is_first) < len(is_first)
    np.testing.assert_array_equal(np.isnan(result.T_world_kf).all(axis=(1, 2)), is_first)
    first_s = [frame.timestamp_s for frame in frames[:6]]
    assert result.unjoined_s.tolist() == result.untracked_s.tolist() == first_s
    for trajectory in (result.odometry, result.trajectory):
        assert trajectory.timestamps_s.tolist() == [each.timestamp_s for each in frames[24:34]]
        np.testing.assert_allclose(trajectory.T_world_cam[0], np.eye(4), atol=1e-9)
    (warning,) = result.warnings
    assert warning.startswith(f"6 of 16 frames, from {first_s[0]:.3f} s to {first_s[-1]:.3f} s")
    placed = {keyframe.id for keyframe in result.keyframes if keyframe.segment == 1}
    assert all({link.ref_id, link.query_id} <= placed for link in result.links)


def test_frames_that_show_nothing_known_end_well(frames, sequence):
    rng = np.random.default_rng(0)

    def strange(frame):
        rgb = np.kron(rng.integers(0, 256, (24, 32, 3), np.uint8), np.ones((10, 10, 1), np.uint8))
        return replace(frame, rgb=rgb, depth_m=np.full_like(frame.depth_m, 2.0))

    result = run([strange(each) if i % 4 == 3 else each for i, each in enumerate(frames[:32])])
    good_s = [frame.timestamp_s for i, frame in enumerate(frames[:32]) if i % 4 != 3]
    assert result.trajectory.timestamps_s.tolist() == good_s
    assert len(result.unjoined_s) == 8
    error = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    assert error.position_errors_m.max() < 0.05


def test_two_sessions_make_one_map(frames, sequence):
    slam = Slam(CAMERA, GradientRecognizer())
    slam.start_session()  # the first may be announced too
    for frame in frames[2:24]:
        slam.process(frame)
    slam.start_session()
    for frame in frames[36:]:
        slam.process(frame)
    result = slam.finish()
    assert result.session_starts_s.tolist() == [frames[36].timestamp_s]
    assert len(result.trajectory) == 46 and not len(result.untracked_s)
    assert [each.segment for each in result.keyframes if each.timestamp_s > 104.0].count(0) == 0
    error = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    assert error.ate_rmse_m < 0.03


def test_sessions_of_poses_from_elsewhere_make_one_map(drifting, sequence):
    slam = Slam(CAMERA, GradientRecognizer())
    T_other_odom = se3.exp(np.array([0.3, 1.2, 0.1, 5.0, 6.0, 7.0]))
    for i, (frame, T_odom_cam) in enumerate(zip(*drifting, strict=True)):
        if i == 8:
            slam.start_session()
        slam.add_keyframe(frame, T_other_odom @ T_odom_cam if i >= 8 else T_odom_cam)
    result = slam.finish()
    assert [each.segment for each in result.keyframes] == [0] * 8 + [1] * 7
    assert [each.id for each in result.keyframes] == list(range(15))
    assert np.isfinite(result.T_world_kf).all()
    np.testing.assert_array_equal(result.odometry.T_world_cam[:8], drifting[1][:8])
    error = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    assert error.ate_rmse_m < 0.05


def uncovered(frames):
    """Return a drive there, three seconds in the dark, and other images of the way near the start.

    The times are new. Where the lens is uncovered the camera was long ago, and not when it was
    covered.
    """
    dark = [black(frame) for frame in frames[:22]]
    some = [*frames[:28], *dark, *frames[49:59]]
    return [replace(frame, timestamp_s=100.0 + i / 7.5) for i, frame in enumerate(some)]


def T_odom_cams(frames):
    """Run frames and return the (4, 4) pose of each as it was placed, None where it was not."""
    slam, T_odom_kf, found = Slam(CAMERA, GradientRecognizer()), {}, []
    for frame in frames:
        placed = slam.process(frame)
        if isinstance(placed, Rejection):
            found.append(None)
            continue
        if placed.new_keyframe:
            T_odom_kf[placed.new_keyframe.id] = placed.new_keyframe.T_odom_cam
            found.append(placed.new_keyframe.T_odom_cam)
        else:
            found.append(T_odom_kf[placed.keyframe_id] @ placed.T_kf_cam)
    return found, slam.finish()


def test_a_lens_that_is_uncovered_at_a_place_seen_long_ago_is_placed_by_its_first_frame(
    frames, T_first_cam
):
    found, result = T_odom_cams(uncovered(frames))
    assert all(each is None for each in found[28:50])
    error = se3.inverse(T_first_cam[49:59]) @ np.array(found[50:])
    assert se3.translation_norm(error).max() < 0.05
    assert np.degrees(se3.rotation_angle(error)).max() < 2.0
    assert {keyframe.segment for keyframe in result.keyframes} == {0}
    assert len(result.trajectory) == 38
    again, result_again = T_odom_cams(uncovered(frames))
    assert [None if each is None else each.tobytes() for each in again] == [
        None if each is None else each.tobytes() for each in found
    ]
    np.testing.assert_array_equal(result_again.T_world_kf, result.T_world_kf)


def test_a_lens_that_is_uncovered_where_nothing_is_known_begins_a_segment(frames):
    later = [replace(frame, timestamp_s=110.0 + i / 7.5) for i, frame in enumerate(frames[24:34])]
    found, result = T_odom_cams([*uncovered(frames)[:10], *uncovered(frames)[28:50], *later])
    np.testing.assert_array_equal(found[32], np.eye(4))
    assert {keyframe.segment for keyframe in result.keyframes} == {0, 1}


# Images of keyframes that do not fit into memory


def test_keyframes_on_disk_are_as_good_as_in_memory(frames, room_run, tmp_path):
    config = Config(keyframes=KeyframesConfig(memory_mb=0))
    slam = Slam(CAMERA, GradientRecognizer(), config, tmp_path)
    for frame in frames:
        slam.process(frame)
    result = slam.finish()
    np.testing.assert_array_equal(result.trajectory.T_world_cam, room_run.trajectory.T_world_cam)
    for ours, theirs in zip(result.keyframes, room_run.keyframes, strict=True):
        np.testing.assert_array_equal(ours.preview.rgb, theirs.preview.rgb)
        np.testing.assert_array_equal(ours.preview.depth_m, theirs.preview.depth_m)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_ends_tracking_and_what_was_done_until_then_can_be_finished(
    frames, tmp_path, monkeypatch
):
    config = Config(keyframes=KeyframesConfig(memory_mb=0))
    slam = Slam(CAMERA, GradientRecognizer(), config, tmp_path)
    placed = 0
    for frame in frames[:20]:
        placed += isinstance(slam.process(frame), TrackedFrame)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        with pytest.raises(SlamError, match="cannot keep what keyframes show: No space left"):
            for frame in frames[20:]:
                placed += isinstance(slam.process(frame), TrackedFrame)
    result = slam.finish()
    assert result.missing == ()
    assert len(result.trajectory) == placed
    assert all(each.preview.depth_m.any() for each in result.keyframes)

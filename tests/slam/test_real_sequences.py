# SPDX-License-Identifier: Apache-2.0
"""The whole pipeline on real recordings, held to what it has to reach there."""

from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.config import EvaluationConfig, InputConfig
from slam.datasets import Sequence, Sessions, open_sequence
from slam.evaluation.drift import DriftReport, compare_drift, trajectory_error
from slam.evaluation.trajectory import write_tum
from slam.output.ledger.writing import write_ledger
from slam.result import SlamResult
from slam.system import Slam
from slam.types import FloatArray


class Run(NamedTuple):
    frames: int
    result: SlamResult
    drift: DriftReport


def run(sequence, count=None):
    slam = Slam(sequence.camera, GradientRecognizer())
    for frame in islice(sequence, count):
        slam.process(frame)
    return slam.finish()


def open_recording(data, name):
    folder = data / f"rgbd_dataset_freiburg1_{name}"
    if not folder.is_dir():
        pytest.skip(f"no copy of fr1_{name} in {data} (LOOPCLOSE_DATA)")
    return open_sequence(folder, InputConfig())


def run_all(data, name):
    sequence = open_recording(data, name)
    result = run(sequence)
    drift = compare_drift(result, sequence.ground_truth, EvaluationConfig())
    return Run(len(sequence), result, drift)


@pytest.fixture(scope="session")
def desk(data):
    return run_all(data, "desk")


@pytest.fixture(scope="session")
def xyz(data):
    return run_all(data, "xyz")


def test_every_frame_of_the_desk_is_tracked_across_the_gap_in_its_fast_turn(desk):
    assert desk.frames == len(desk.result.trajectory) == 595
    assert len(desk.result.untracked_s) == 0


def test_the_drift_on_the_desk(desk):
    drift = desk.drift
    assert drift.odometry.ate_rmse_m <= 0.0165
    assert drift.live.ate_rmse_m <= 0.0150
    assert drift.corrected.ate_rmse_m <= 0.0125
    assert drift.corrected.rpe_translation_m <= 0.020
    assert drift.corrected.matched_share > 0.99 and drift.coverage > 0.99


def test_the_drift_on_xyz(xyz):
    assert len(xyz.result.untracked_s) == 0
    assert xyz.drift.corrected.ate_rmse_m <= 0.008


@pytest.mark.parametrize("name", ["desk", "xyz"])
def test_no_correction_makes_it_worse(name, request, assert_no_correction_hurts):
    assert_no_correction_hurts(request.getfixturevalue(name).drift)


@pytest.mark.parametrize("name", ["desk", "xyz"])
def test_motions_are_as_far_off_as_they_say(name, request):
    drift = request.getfixturevalue(name).drift
    assert 3.0 < drift.median_links_nees < 9.0
    assert 2.5 < drift.median_loops_nees < 10.0  # the fewer, the further off that may be


@pytest.mark.parametrize("name", ["desk", "xyz"])
def test_loops_are_closed_and_none_of_them_is_false(name, request):
    verdicts = [loop.is_false for loop in request.getfixturevalue(name).drift.loops]
    assert verdicts.count(False) >= 10
    assert verdicts.count(True) == 0


class Covered(NamedTuple):
    """A run over the desk whose lens was covered for a second, once or more."""

    result: SlamResult
    sequence: Sequence
    since_s: FloatArray  # of each frame, from the first of all
    is_covered: np.ndarray


def cover_the_lens(data, *starts_s):
    sequence = open_recording(data, "desk")
    since_s = sequence.timestamps_s - sequence.timestamps_s[0]
    is_covered = np.any([(since_s >= at) & (since_s < at + 1.0) for at in starts_s], axis=0)
    slam = Slam(sequence.camera, GradientRecognizer())
    for frame, is_dark in zip(sequence, is_covered, strict=True):
        if is_dark:
            frame = replace(frame, rgb=0 * frame.rgb, depth_m=0 * frame.depth_m)
        slam.process(frame)
    return Covered(slam.finish(), sequence, since_s, is_covered)


@pytest.fixture(scope="module")
def covered_twice(data):
    """Cover it where the camera never comes back to, and in the middle, where it does at once."""
    return cover_the_lens(data, 1.0, 9.4)


def test_every_frame_after_a_covered_lens_is_placed_where_the_camera_comes_back(covered_twice):
    result, sequence, since_s, is_covered = covered_twice
    is_placed = (since_s >= 2.0) & ~is_covered
    np.testing.assert_array_equal(result.untracked_s, sequence.timestamps_s[~is_placed])
    assert {
        each.segment
        for each in result.keyframes
        if each.timestamp_s > sequence.timestamps_s[0] + 2.0
    } == {1}
    assert_all_are_near(covered_twice, 10.4)


def test_what_was_before_a_covered_lens_and_is_never_seen_again_is_left_out(covered_twice):
    result, sequence, since_s, is_covered = covered_twice
    is_later = (since_s >= 2.0) & ~is_covered
    np.testing.assert_array_equal(result.trajectory.timestamps_s, sequence.timestamps_s[is_later])
    assert_all_are_near(covered_twice, 2.0)


def test_every_frame_after_a_covered_lens_is_placed_where_it_comes_back_elsewhere(data):
    covered = cover_the_lens(data, 7.0)
    result, sequence, _, is_covered = covered
    np.testing.assert_array_equal(result.untracked_s, sequence.timestamps_s[is_covered])
    np.testing.assert_array_equal(
        result.trajectory.timestamps_s, sequence.timestamps_s[~is_covered]
    )
    assert len({keyframe.segment for keyframe in result.keyframes}) == 2
    assert_all_are_near(covered, 8.0)


def assert_all_are_near(covered, from_s):
    result, sequence, _, _ = covered
    error = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    is_later = error.timestamps_s >= sequence.timestamps_s[0] + from_s
    assert np.count_nonzero(is_later) > 250
    assert error.position_errors_m[is_later].max() < 0.05
    assert error.ate_rmse_m <= 0.017


def test_two_sessions_make_one_connected_map(data):
    sessions = Sessions([open_recording(data, name) for name in ("xyz", "desk")])
    slam = Slam(sessions.camera, GradientRecognizer())
    for recording, count in zip(sessions.recordings, (200, 150), strict=True):
        slam.start_session()
        for frame in islice(recording, count):
            slam.process(frame)
    result = slam.finish()
    assert len(result.trajectory) == 350 and len(result.untracked_s) == 0
    assert np.isfinite(result.T_world_kf).all()
    truth = sessions.ground_truth
    error = trajectory_error(result.trajectory, truth, EvaluationConfig())
    assert error.ate_rmse_m <= 0.012 and error.matched_share > 0.99


def test_two_runs_write_the_same_bytes(data, tmp_path):
    for name in ("one", "two"):
        result = run(open_recording(data, "desk"), count=100)
        write_tum(tmp_path / f"{name}.txt", result.trajectory)
        write_ledger(tmp_path / f"{name}.jsonl", result, None)
    for suffix in ("txt", "jsonl"):
        first, second = ((tmp_path / f"{name}.{suffix}").read_bytes() for name in ("one", "two"))
        assert first == second and first

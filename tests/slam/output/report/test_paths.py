# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from slam.output.report.paths import SESSION_GAP_S, broken, gather
from slam.types import Trajectory

PER_KEYFRAME = 5  # frames, in the run of conftest.py


def test_paths_are_brought_into_the_frame_of_the_truth(run) -> None:
    T_truth_world = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], float)
    drift = replace(run.drift, corrected=replace(run.drift.corrected, T_truth_world=T_truth_world))
    paths = gather(run.result, drift, run.truth)
    x, y, z = run.result.trajectory.T_world_cam[10, :3, 3]
    assert_allclose(paths.after_m[10], (5 - y, 6 + x, 7 + z))
    assert_allclose(paths.keyframes_m[2], paths.after_m[10])
    assert paths.in_truth_frame


def test_the_axis_with_the_most_motion_comes_first(run) -> None:
    assert gather(run.result, run.drift, None).axes == (0, 1, 2)


def test_truth_outside_the_run_is_not_drawn(run) -> None:
    times = np.arange(-5.0, 40.0, 0.1)
    truth = Trajectory(times, np.tile(np.eye(4), (len(times), 1, 1)))
    paths = gather(run.result, run.drift, truth)
    assert paths.truth_times_s.min() >= -1e-9
    assert paths.truth_times_s.max() <= paths.times_s[-1] + 1e-6


def test_keyframes_are_in_truth_where_it_has_a_pose_within_the_tolerance(run) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (1, 2, 3)
    stamps_s = np.array([keyframe.timestamp_s for keyframe in run.result.keyframes])
    truth = Trajectory(stamps_s[[0, 2, 5]] + (0.01, -0.01, 0.03), poses)
    found = gather(run.result, run.drift, truth).keyframe_truth_m
    assert_allclose(found[:6, 0], (1, np.nan, 2, np.nan, np.nan, np.nan))
    assert np.isnan(found[6:]).all()
    assert not gather(run.result, None, truth).has_keyframe_truth


def test_lines_break_where_frames_are_missing() -> None:
    times = np.array([0.0, 0.1, 0.2, 2.0, 2.1])
    broken_times, values = broken(times, np.arange(5.0))
    assert_allclose(broken_times, (0.0, 0.1, 0.2, np.nan, 2.0, 2.1))
    assert_allclose(values, (0, 1, 2, np.nan, 3, 4))
    assert len(broken(times[:1], times[:1])[0]) == 1


def test_the_breaks_between_sessions_are_left_out(run, altered) -> None:
    times = run.result.trajectory.timestamps_s.copy()
    times[30:] += 100.0
    later = replace(run.result.trajectory, timestamps_s=times)
    keyframes = [
        replace(each, timestamp_s=times[k * PER_KEYFRAME])
        for k, each in enumerate(run.result.keyframes)
    ]
    result = altered(session_starts_s=times[30:31], keyframes=tuple(keyframes))
    paths = gather(replace(result, trajectory=later, odometry=later), None, None)
    keyframes_s = np.array([each.timestamp_s for each in keyframes])
    assert_allclose(paths.elapsed_s(keyframes_s), paths.times_s[::PER_KEYFRAME])
    assert_allclose(np.diff(paths.times_s[:30]), np.diff(times[:30]))
    assert_allclose(np.diff(paths.times_s[30:]), np.diff(times[30:]))
    assert paths.times_s[30] - paths.times_s[29] == pytest.approx(SESSION_GAP_S)
    assert paths.session_starts.tolist() == [0, 30]
    assert_allclose(paths.elapsed_s(times), paths.times_s)


def test_a_session_without_any_place_starts_nowhere(run, altered) -> None:
    lost_s = run.result.trajectory.timestamps_s[0] - np.array([9.0, 8.5, 4.0])
    result = altered(
        untracked_s=lost_s, session_starts_s=run.result.trajectory.timestamps_s[[0, 30]]
    )
    assert gather(result, None, None).session_starts.tolist() == [0, 30]


def test_truth_between_two_sessions_is_not_drawn(run, altered) -> None:
    times = run.result.trajectory.timestamps_s.copy()
    times[30:] += 100.0
    later = replace(run.result.trajectory, timestamps_s=times)
    result = replace(altered(session_starts_s=times[30:31]), trajectory=later, odometry=later)
    stamps = np.arange(times[0] - 5.0, times[-1] + 5.0, 0.1)
    truth = Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    drawn = gather(result, run.drift, truth).truth_times_s + times[0]
    assert not ((drawn > times[29] + 0.01) & (drawn < times[30] - 0.01)).any()
    assert (drawn < times[29]).any() and (drawn > times[30]).any()

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from slam.output.report.paths import SESSION_GAP_S, at_keyframes, gather
from slam.types import Trajectory

PER_KEYFRAME = 5  # frames, in the run of conftest.py


def test_paths_are_brought_into_the_frame_of_the_truth(run) -> None:
    T_truth_world = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], float)
    drift = replace(run.drift, corrected=replace(run.drift.corrected, T_truth_world=T_truth_world))
    paths = gather(run.result, drift)
    x, y, z = run.result.trajectory.T_world_cam[10, :3, 3]
    assert_allclose(paths.corrected[10, :3, 3], (5 - y, 6 + x, 7 + z))
    assert_allclose(paths.keyframes_m[2], paths.corrected[10, :3, 3])
    assert paths.in_truth_frame


def test_truth_is_known_where_it_has_a_pose_within_the_tolerance(run) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (1, 2, 3)
    stamps_s = np.array([keyframe.timestamp_s for keyframe in run.result.keyframes])
    truth = Trajectory(stamps_s[[0, 2, 5]] + (0.01, -0.01, 0.03), poses)
    paths = gather(run.result, replace(run.drift, truth=truth))
    found = paths.keyframe_truth_m
    assert_allclose(found[:6, 0], (1, np.nan, 2, np.nan, np.nan, np.nan))
    assert np.isnan(found[6:]).all() and paths.has_keyframe_truth
    assert not gather(run.result, None).has_keyframe_truth


def test_a_keyframe_without_a_place_has_no_frame(run) -> None:
    keyframes = list(run.result.keyframes)
    keyframes[3] = replace(keyframes[3], timestamp_s=keyframes[3].timestamp_s + 0.01)
    frames = gather(replace(run.result, keyframes=tuple(keyframes)), None).keyframe_frames
    assert frames[:5].tolist() == [0, 5, 10, -1, 20]
    assert_allclose(at_keyframes(np.arange(200.0), frames)[:5], (0, 5, 10, np.nan, 20))


def test_lines_break_where_frames_are_missing(run) -> None:
    paths = gather(run.result, None)
    assert paths.breaks.tolist() == []
    assert replace(paths, times_s=np.array([0.0, 0.1, 0.2, 2.0, 2.1])).breaks.tolist() == [3]
    assert replace(paths, times_s=np.zeros(1)).breaks.tolist() == []


def test_up_is_where_upright_cameras_have_it(run) -> None:
    assert gather(run.result, None).up.tolist() == [0, -1, 0]  # a camera's y axis points down
    T_truth_world = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
    drift = replace(run.drift, corrected=replace(run.drift.corrected, T_truth_world=T_truth_world))
    assert gather(run.result, drift).up.tolist() == [0, 0, 1]


def test_drift_is_enlarged_until_it_can_be_seen(run) -> None:
    paths = gather(run.result, None)
    far = paths.corrected.copy()
    far[:, 0, 3] += 0.02  # of a path that is 3 m wide
    paths = replace(paths, odometry=far, without_loops=paths.corrected)
    assert paths.enlargement == 10
    drawn = paths.enlarged(paths.odometry[:, :3, 3], 10)
    assert_allclose(drawn[:, 0] - paths.corrected[:, 0, 3], 0.2)
    assert replace(paths, odometry=paths.corrected + 9.0).enlargement == 1
    assert replace(paths, odometry=paths.corrected).enlargement == 1  # there is none


def test_where_truth_is_unknown_nothing_is_enlarged(run) -> None:
    paths = gather(run.result, run.drift)
    truth_m = paths.truth_m.copy()
    truth_m[50:] = np.nan
    paths = replace(paths, truth_m=truth_m)
    points_m = paths.odometry[:, :3, 3]
    drawn = paths.enlarged(points_m, 5)
    assert_allclose(drawn[50:], points_m[50:])
    assert_allclose(drawn[:50] - truth_m[:50], 5 * (points_m[:50] - truth_m[:50]), atol=1e-12)


def test_the_breaks_between_sessions_are_left_out(run, altered) -> None:
    times = run.result.trajectory.timestamps_s.copy()
    times[30:] += 100.0
    later = replace(run.result.trajectory, timestamps_s=times)
    keyframes = [
        replace(each, timestamp_s=times[k * PER_KEYFRAME])
        for k, each in enumerate(run.result.keyframes)
    ]
    result = altered(session_starts_s=times[30:31], keyframes=tuple(keyframes))
    paths = gather(replace(result, trajectory=later, odometry=later), None)
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
    assert gather(result, None).session_starts.tolist() == [0, 30]

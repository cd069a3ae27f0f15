# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.external_odometry.given_poses import GivenPoses, poses_between
from slam.geometry import se3
from slam.types import Trajectory

SPEED = np.array([0.1, -0.4, 0.3, 0.5, -0.2, 0.7])  # rad/s, m/s


def steady(stamps_s):
    stamps_s = np.asarray(stamps_s, dtype=np.float64)
    return Trajectory(stamps_s, se3.exp(stamps_s[:, None] * SPEED))


def is_known(known, stamps_s):
    return np.isfinite(poses_between(known, np.array(stamps_s))).all(axis=(1, 2)).tolist()


def test_at_a_stamp_a_pose_is_what_was_given_to_the_bit(walk):
    found = poses_between(walk, walk.timestamps_s[[0, 5, 6, 599]])
    np.testing.assert_array_equal(found, walk.T_world_cam[[0, 5, 6, 599]])


def test_in_between_the_camera_moves_steadily():
    stamps_s = np.array([0.93, 0.02, 0.5, 0.999])
    found = poses_between(steady(np.linspace(0.0, 1.0, 11)), stamps_s)
    np.testing.assert_allclose(found, steady(stamps_s).T_world_cam, atol=1e-12)


def test_before_the_first_and_after_the_last_nothing_is_known():
    known = steady([1.0, 1.1, 1.2])
    stamps_s = [0.99, 1.0, 1.2, 1.201]
    assert is_known(known, stamps_s) == [False, True, True, False]
    assert np.isnan(poses_between(known, np.array([0.99]))).all()


@pytest.mark.parametrize(
    ("step_s", "gap_s", "is_bridged"),
    [
        (0.1, 0.29, True),
        (0.1, 0.31, False),
        (0.01, 0.049, True),  # two poses lost at 100 a second, and one more
        (0.01, 0.051, False),
        (0.2, 0.49, True),
        (0.2, 0.51, False),
    ],
)
def test_a_gap_of_a_few_usual_steps_is_bridged(step_s, gap_s, is_bridged):
    stamps_s = np.arange(10) * step_s
    stamps_s[5:] += gap_s - step_s
    known = steady(stamps_s)
    middle_s = stamps_s[4] + 0.5 * gap_s
    asked = [stamps_s[4], middle_s, stamps_s[5], stamps_s[5] + 0.4 * step_s]
    assert is_known(known, asked) == [True, is_bridged, True, True]


def test_of_one_pose_only_its_own_time_is_known_and_of_none_nothing():
    assert is_known(steady([2.0]), [1.9, 2.0, 2.1]) == [False, True, False]
    assert is_known(GivenPoses().trajectory, [0.0, 1.0]) == [False, False]


@pytest.fixture
def given():
    """Return poses 0.1 s apart of which all but the first tell a covariance, a whole multiple."""
    given = GivenPoses()
    for i, T in enumerate(steady(np.arange(6) / 10).T_world_cam):
        given.add(i / 10, T, i * np.eye(6) if i else None)
    return given


def test_poses_come_back_as_they_were_given(given):
    expected = steady(np.arange(6) / 10)
    assert (len(given), given.last_s) == (6, 0.5)
    np.testing.assert_array_equal(given.trajectory.timestamps_s, expected.timestamps_s)
    np.testing.assert_array_equal(given.trajectory.T_world_cam, expected.T_world_cam)


@pytest.mark.parametrize(
    ("time_s", "first"),
    [(-1.0, 0), (0.0, 0), (0.05, 0), (0.1, 0), (0.11, 1), (0.45, 4), (0.5, 4), (9.0, 4)],
)
def test_two_poses_are_around_a_time_or_nearest_to_it(given, time_s, first):
    found, expected = given.around(time_s), steady(np.arange(6) / 10)
    np.testing.assert_array_equal(found.timestamps_s, expected.timestamps_s[first : first + 2])
    np.testing.assert_array_equal(found.T_world_cam, expected.T_world_cam[first : first + 2])


@pytest.mark.parametrize(
    ("time_s", "expected"),
    [(0.0, True), (0.3, True), (0.3005, True), (0.35, False), (-0.1, False), (0.502, False)],
)
def test_it_is_known_whether_a_pose_is_of_a_time(given, time_s, expected):
    assert given.is_at(time_s) is expected
    assert not GivenPoses().is_at(time_s)


def test_before_there_is_one_any_time_is_later_than_the_last():
    assert GivenPoses().last_s == -np.inf
    assert len(GivenPoses()) == len(GivenPoses().around(0.0)) == 0
    assert GivenPoses().covariance(0.0, 1.0) is None


@pytest.mark.parametrize(
    ("start_s", "end_s", "expected"),
    [
        (0.0, 0.1, 1),
        (0.1, 0.3, 2 + 3),
        (0.0, 0.5, 1 + 2 + 3 + 4 + 5),
        (0.15, 0.35, 2 + 3),
        (-1.0, 0.2, None),  # what led to the first is not told
        (0.3, 0.3, None),
    ],
)
def test_covariances_of_parts_add_up_to_that_of_the_whole(given, start_s, end_s, expected):
    found = given.covariance(start_s, end_s)
    if expected is None:
        assert found is None
    else:
        np.testing.assert_array_equal(found, expected * np.eye(6))


def test_where_one_part_is_not_told_the_whole_is_not(given):
    given.add(0.6, np.eye(4))
    given.add(0.7, np.eye(4), np.eye(6))
    assert given.covariance(0.4, 0.7) is None
    np.testing.assert_array_equal(given.covariance(0.6, 0.7), np.eye(6))

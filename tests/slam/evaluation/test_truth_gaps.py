# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.evaluation.truth_gaps import without_gaps
from slam.geometry import se3
from slam.types import SlamError, Trajectory


def path(stamps_s):
    """Along x at 0.5 m/s, turning by 0.4 rad/s."""
    tangents = np.zeros((len(stamps_s), 6))
    tangents[:, 2] = 0.4 * stamps_s
    poses = se3.exp(tangents)
    poses[:, 0, 3] = 0.5 * stamps_s
    return Trajectory(stamps_s, poses)


ESTIMATE = path(np.arange(0.0, 10.0, 0.1))
TRUTH = path(np.arange(0.0, 10.0, 0.01))


def changed(**poses):
    """Return the truth with some of its poses replaced, by their number."""
    T_world_cam = TRUTH.T_world_cam.copy()
    for name, pose in poses.items():
        T_world_cam[int(name[1:])] = pose
    return Trajectory(TRUTH.timestamps_s, T_world_cam)


def at(x_m, y_m=0.0):
    T = np.eye(4)
    T[:2, 3] = x_m, y_m
    return T


def test_poses_that_are_some_are_left_as_they_are():
    assert without_gaps(TRUTH, ESTIMATE) == (TRUTH, ())


def test_numbers_that_no_place_has_are_none():
    truth = changed(_5=at(1e200), _7=np.full((4, 4), np.nan), _9=at(-np.inf))
    known, doubts = without_gaps(truth, ESTIMATE)
    assert len(known) == len(TRUTH) - 3
    assert doubts == (
        "3 of 1000 true poses are in no numbers that a place can have; they are gaps in the ground"
        " truth",
    )
    everywhere = Trajectory(TRUTH.timestamps_s, np.full((1000, 4, 4), 1e308))
    with pytest.raises(SlamError, match="no poses in numbers that a place can have"):
        without_gaps(everywhere, ESTIMATE)


def test_poses_that_leap_to_and_fro_are_none():
    turned = TRUTH.T_world_cam[500] @ se3.exp(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    known, doubts = without_gaps(changed(_300=at(1.5, 0.3), _500=turned), ESTIMATE)
    missing = np.setdiff1d(TRUTH.timestamps_s, known.timestamps_s)
    np.testing.assert_allclose(missing, [3.0, 5.0])
    assert "2 of 1000 true poses leap to and fro" in doubts[0]


def test_a_leap_that_stays_is_none_of_them():
    T_world_cam = TRUTH.T_world_cam.copy()
    T_world_cam[500:, 1, 3] += 1.0
    assert without_gaps(Trajectory(TRUTH.timestamps_s, T_world_cam), ESTIMATE)[1] == ()


def test_between_poses_far_apart_a_camera_may_go_to_and_fro():
    seldom = path(np.arange(0.0, 10.0, 0.5))
    seldom.T_world_cam[::2, 1, 3] += 0.5
    assert without_gaps(seldom, ESTIMATE)[1] == ()


def test_poses_that_stay_the_same_while_the_camera_moves_are_none():
    held = {f"_{i}": TRUTH.T_world_cam[400] for i in range(400, 450)}
    known, doubts = without_gaps(changed(**held), ESTIMATE)
    assert len(known) == 950
    assert "50 of 1000 true poses stay the same while the camera moves" in doubts[0]


@pytest.mark.parametrize("count", [2, 4], ids=["once more", "within a step of the camera's"])
def test_poses_that_stay_the_same_for_a_moment_are_some(count):
    held = {f"_{i}": TRUTH.T_world_cam[400] for i in range(400, 400 + count)}
    assert without_gaps(changed(**held), ESTIMATE)[1] == ()


def test_poses_that_stay_the_same_as_the_camera_does_are_some():
    T_world_cam = ESTIMATE.T_world_cam.copy()
    T_world_cam[40:46] = T_world_cam[40]
    held = {f"_{i}": TRUTH.T_world_cam[400] for i in range(400, 450)}
    steady = Trajectory(ESTIMATE.timestamps_s, T_world_cam)
    assert without_gaps(changed(**held), steady)[1] == ()

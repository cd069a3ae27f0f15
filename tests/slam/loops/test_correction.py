# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.loops.correction import Correction

T_WORLD_KF = {
    k: se3.exp(np.array([0.2 * k, -0.1 * k, 0.0, 0.3 * k, 0.0, 0.1 * k * k])) for k in range(6)
}
T_WORLD_GIVEN = se3.exp(np.array([0.3, -1.2, 0.4, 2.0, 1.0, -3.0]))
T_ELSEWHERE = se3.exp(np.array([0.02, 0.0, -0.05, 0.1, 0.0, -0.03]))
T_GIVEN_KF = {k: se3.inverse(T_WORLD_GIVEN) @ T for k, T in T_WORLD_KF.items()}


def by_images(T_world_start, ids=range(6)):
    """Return a correction that follows tracking, in which the keyframes lie elsewhere."""
    T_world_kf = {k: T_world_start @ T_WORLD_KF[k] for k in ids}
    return Correction(1, 5, T_world_kf, {0: T_world_start})


def by_given(T_world_start):
    """Return one that follows the given odometry, by what the graph makes of it, elsewhere."""
    moved = by_images(T_world_start)
    return replace(moved, T_world_given=T_world_start @ T_WORLD_GIVEN)


@pytest.mark.parametrize("turn", [by_images, by_given], ids=["to the images", "to the odometry"])
def test_the_camera_does_not_leap_where_something_else_is_followed(turn):
    before = {by_images: by_given, by_given: by_images}[turn](np.eye(4))
    found = turn(T_ELSEWHERE).after(before, T_GIVEN_KF)
    np.testing.assert_allclose(found.T_world_start, se3.inverse(T_ELSEWHERE), atol=1e-12)
    if turn is by_images:
        np.testing.assert_allclose(found.T_world_odom[0], np.eye(4), atol=1e-12)
        for k, T in found.T_world_kf.items():
            np.testing.assert_allclose(T, T_WORLD_KF[k], atol=1e-12)
    else:
        np.testing.assert_allclose(found.T_world_given, T_WORLD_GIVEN, atol=1e-12)


def test_one_bent_keyframe_does_not_turn_the_world():
    bent = by_images(np.eye(4))
    bend = se3.exp(np.array([0.05, 0.0, 0.0, 0.02, 0.0, 0.0]))
    T_world_kf = {k: T @ bend if k == 0 else T for k, T in bent.T_world_kf.items()}
    T_world_kf = {k: se3.inverse(T_world_kf[0]) @ T for k, T in T_world_kf.items()}
    found = Correction(1, 5, T_world_kf, {0: np.eye(4)}).after(by_given(np.eye(4)), T_GIVEN_KF)
    off = [se3.inverse(T_WORLD_KF[k]) @ found.T_world_kf[k] for k in range(1, 6)]
    assert np.degrees(se3.rotation_angle(np.array(off))).max() < 0.6  # of 2.9
    left = by_images(se3.inverse(bend)).after(by_images(np.eye(4)), {})
    np.testing.assert_array_equal(left.T_world_odom[0], se3.inverse(bend))


def test_the_world_stays_while_the_same_is_followed_and_goes_back_with_what_was():
    moved = by_images(T_ELSEWHERE).after(by_given(np.eye(4)), T_GIVEN_KF)
    later = by_images(T_ELSEWHERE).after(moved, T_GIVEN_KF)
    np.testing.assert_array_equal(later.T_world_start, moved.T_world_start)
    back = by_given(np.eye(4)).after(later, T_GIVEN_KF)
    np.testing.assert_allclose(back.T_world_given, T_WORLD_GIVEN, atol=1e-12)


@pytest.mark.parametrize("turn", [by_images, by_given], ids=["to the images", "to the odometry"])
def test_poses_from_before_a_leap_of_the_odometry_turn_nothing(turn):
    """They are of another world than those after it, by which it is corrected now."""
    T_given_kf = {k: T_ELSEWHERE @ T if k < 3 else T for k, T in T_GIVEN_KF.items()}
    before = {by_images: by_given, by_given: by_images}[turn](np.eye(4))
    found = turn(np.eye(4)).after(before, T_given_kf)
    np.testing.assert_allclose(found.T_world_start, np.eye(4), atol=1e-12)


def test_the_first_correction_of_all_is_by_the_odometry_alone():
    before = Correction(0, -1, {}, {0: np.eye(4)}, T_WORLD_GIVEN)
    found = by_images(T_ELSEWHERE).after(before, T_GIVEN_KF)
    np.testing.assert_allclose(found.T_world_start, se3.inverse(T_ELSEWHERE), atol=1e-12)


def test_the_world_stays_where_poses_count_from_another_keyframe():
    later = by_images(se3.inverse(T_WORLD_KF[2]), range(2, 6))
    found = later.after(by_images(np.eye(4)), {})
    np.testing.assert_allclose(found.T_world_odom[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(found.T_world_kf[5], T_WORLD_KF[5], atol=1e-12)


def test_where_nothing_is_known_of_both_the_world_stays():
    before = Correction(0, -1, {}, {0: np.eye(4)})  # of frames without a pose
    found = by_given(T_ELSEWHERE).after(before, T_GIVEN_KF)
    np.testing.assert_array_equal(found.T_world_start, np.eye(4))

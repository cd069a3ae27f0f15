# SPDX-License-Identifier: Apache-2.0
from itertools import product

import numpy as np
import pytest

from slam.external_odometry.conventions import Convention
from slam.geometry import se3
from slam.types import Trajectory


def quarter_turn(axis, *translation_m):
    T = se3.exp(np.array([*(np.pi / 2 * np.eye(3)[axis]), 0.0, 0.0, 0.0]))
    T[:3, 3] = translation_m
    return T


def one(T, stamp_s=0.0):
    return Trajectory(np.array([stamp_s]), T[None])


def read(T, **convention):
    return Convention(**convention).camera_poses(one(T)).T_world_cam[0]


@pytest.mark.parametrize("is_mounted", [False, True], ids=["camera", "body"])
@pytest.mark.parametrize(("is_inverted", "is_w_first"), list(product([False, True], repeat=2)))
@pytest.mark.parametrize(("scale", "time_offset_s"), [(1.0, 0.0), (0.3048, 0.0), (2.5, -0.4)])
def test_poses_that_are_read_are_written_back_as_they_were_given(
    walk, T_base_cam, is_mounted, is_inverted, is_w_first, scale, time_offset_s
):
    T = T_base_cam if is_mounted else np.eye(4)
    convention = Convention(T, scale, time_offset_s, is_inverted, is_w_first)
    camera = convention.camera_poses(walk)
    for found, expected in (
        (convention.as_given(camera), walk),
        (convention.camera_poses(convention.as_given(walk)), walk),
    ):
        np.testing.assert_allclose(found.T_world_cam, expected.T_world_cam, atol=1e-12)
        np.testing.assert_allclose(found.timestamps_s, expected.timestamps_s, atol=1e-12)


def test_nothing_said_is_the_cameras_own_pose():
    T = quarter_turn(1, 1.0, 2.0, 3.0)
    np.testing.assert_array_equal(read(T), T)


def test_the_camera_is_seen_from_the_body_and_its_clock_is_that_of_the_images():
    convention = Convention(T_base_cam=quarter_turn(0, 0.1, 0.0, 0.5), scale=0.5, time_offset_s=0.2)
    given = one(quarter_turn(2, 4.0, 0.0, 0.0), stamp_s=3.2)
    camera = convention.camera_poses(given)
    assert camera.timestamps_s == pytest.approx([3.0])
    # The body is 2 m ahead and looks to the left: its 0.1 m ahead are the world's to the left.
    np.testing.assert_allclose(camera.T_world_cam[0, :3, 3], [2.0, 0.1, 0.5], atol=1e-12)
    right_of_camera = camera.T_world_cam[0, :3, :3] @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(right_of_camera, [0.0, 1.0, 0.0], atol=1e-12)
    body = convention.body_poses(given)
    np.testing.assert_allclose(body.T_world_cam[0], quarter_turn(2, 2.0, 0.0, 0.0), atol=1e-12)


def test_inverted_poses_take_the_world_to_the_body():
    T_world_cam = read(quarter_turn(2, 2.0, 0.0, 0.0), is_inverted=True, scale=3.0)
    np.testing.assert_allclose(T_world_cam[:3, 3], [0.0, 6.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T_world_cam[:3, :3] @ [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], atol=1e-12)


def test_a_quaternion_w_x_y_z_was_read_as_if_w_came_last():
    # A quarter turn about z, w first: 0.707 0 0 0.707, is about x where w comes last.
    found = read(quarter_turn(0, 1.0, 2.0, 3.0), is_w_first=True)
    np.testing.assert_allclose(found, quarter_turn(2, 1.0, 2.0, 3.0), atol=1e-12)
    # And z is the last of x y z w written second.
    found = read(quarter_turn(1, 0.0, 0.0, 0.0), is_w_first=True)
    expected = se3.from_quaternion(np.array([1.0, 0.0, 1.0, 0.0]))
    np.testing.assert_allclose(found[:3, :3], expected, atol=1e-12)


def test_what_was_given_is_left_as_it_is(walk, T_base_cam):
    T = walk.T_world_cam.copy()
    convention = Convention(T_base_cam, 2.0, 0.1, is_inverted=True, is_w_first=True)
    convention.camera_poses(walk), convention.as_given(walk)
    np.testing.assert_array_equal(walk.T_world_cam, T)

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.place_recognition.perfect_judges import NOTHING_IN_COMMON, View, look_again
from slam.geometry.se3 import from_rotation_translation, inverse, transform
from slam.types import Camera, FloatArray

CAMERA = Camera(200, 160, 200.0, 200.0, 99.5, 79.5)
FAR_M = 2.0


def view(T_world_cam: FloatArray, nearer_m: float = FAR_M) -> View:
    """Return what a camera sees of a wall 2 m before it; in front of the right half is another."""
    rows, columns = np.mgrid[:160:4, :200:4].reshape(2, -1)
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy], axis=1)
    depth_m = np.full((160, 200), FAR_M)
    depth_m[:, 100:] = nearer_m
    z_m = depth_m[rows, columns]
    points_m = np.column_stack([rays * z_m[:, None], z_m])
    return View(transform(T_world_cam, points_m), rays, depth_m, inverse(T_world_cam))


def aside(x_m: float, yaw_rad: float = 0.0, roll_rad: float = 0.0, z_m: float = 0.0) -> FloatArray:
    rotation = Rotation.from_euler("yz", [yaw_rad, roll_rad]).as_matrix()
    return from_rotation_translation(rotation, np.array([x_m, 0.0, z_m]))


def test_an_image_has_not_changed_from_itself():
    assert look_again(view(np.eye(4)), view(np.eye(4)), CAMERA) == pytest.approx((1.0, 0.0, 0.0))


def test_a_step_aside_moves_all_parts_alike_and_some_out_of_sight():
    change = look_again(view(np.eye(4)), view(aside(0.5)), CAMERA)  # a quarter of the width
    assert change.seen == pytest.approx(0.75, abs=0.02)
    assert change.moved == pytest.approx(0.75 * 0.25 + 0.25, abs=0.02)
    assert change.bent == pytest.approx(0.0, abs=1e-9)


def test_a_step_ahead_and_a_roll_bend_what_is_seen():
    ahead = look_again(view(np.eye(4)), view(aside(0.0, z_m=0.5)), CAMERA)
    assert ahead.bent == pytest.approx(np.linalg.norm(np.eye(2) / 3.0), rel=1e-6)
    rolled = look_again(view(np.eye(4)), view(aside(0.0, roll_rad=0.2)), CAMERA)
    turn = Rotation.from_euler("z", -0.2).as_matrix()[:2, :2]
    assert rolled.bent == pytest.approx(np.linalg.norm(turn - np.eye(2)), rel=1e-6)


def test_what_something_nearer_hides_is_not_seen():
    change = look_again(view(np.eye(4)), view(np.eye(4), nearer_m=1.0), CAMERA)
    assert change.seen == pytest.approx(0.5, abs=0.02)
    assert change.moved == pytest.approx(0.5, abs=0.02)


def test_views_that_look_apart_have_nothing_in_common():
    change = look_again(view(np.eye(4)), view(aside(0.0, yaw_rad=np.pi)), CAMERA)
    assert change == (0.0, 1.0, NOTHING_IN_COMMON)

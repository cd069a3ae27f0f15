# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from slam.demo.panels import Panel
from slam.demo.recording import drive
from slam.demo.room import ROOM_SIZE_M, assemble, build_room, render
from slam.geometry import se3
from slam.geometry.features import back_project, undistort
from slam.types import Camera

SMALL = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)


@pytest.fixture(scope="module")
def room():
    return build_room(3)


def world_points(camera, depth_m, T_world_cam):
    v, u = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    points_cam = back_project(undistort(pixels, camera), depth_m.ravel().astype(float), camera)
    return se3.transform(T_world_cam, points_cam)


def test_a_picture_hangs_the_right_way_round_and_undistorted():
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32], texture[:32, 32:] = (250, 0, 0), (0, 250, 0)
    texture[32:, :32], texture[32:, 32:] = (0, 0, 250), (250, 250, 0)
    corner, right, down = np.array([-1.0, -1.0, 2.0]), np.array([2.0, 0, 0]), np.array([0, 2.0, 0])
    seen = render(assemble([Panel(corner, right, down, texture)]), SMALL, np.eye(4), 7.5)
    assert seen.timestamp_s == 7.5
    assert np.allclose(seen.depth_m[55:65, 75:85], 2.0)
    # One metre is 65.6 pixels from here: half a metre up and left of the middle is red, and so on.
    assert seen.rgb[27, 47].tolist() == [250, 0, 0]
    assert seen.rgb[27, 112].tolist() == [0, 250, 0]
    assert seen.rgb[92, 47].tolist() == [0, 0, 250]
    assert seen.rgb[92, 112].tolist() == [250, 250, 0]
    assert (seen.depth_m[:, :10] == 0).all() and (seen.rgb[:, :10] == 0).all()


def test_the_room_is_closed_and_all_its_surfaces_lie_inside(room):
    for T_world_cam in drive(np.linspace(0.0, 12.0, 7), seed=0):
        depth_m = render(room, SMALL, T_world_cam).depth_m
        assert depth_m.dtype == np.float32 and depth_m.min() > 0.4
        points = world_points(SMALL, depth_m, T_world_cam)
        low, high = points.min(axis=0), points.max(axis=0)
        half = np.array([ROOM_SIZE_M[0] / 2, ROOM_SIZE_M[1] / 2])
        assert (np.abs([low[:2], high[:2]]) <= half + 1e-3).all()
        assert low[2] >= -1e-3 and high[2] <= ROOM_SIZE_M[2] + 1e-3


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (0.2, -0.5, 0.003, -0.002, 0.3)])
def test_two_views_agree_on_where_surfaces_are_and_what_they_look_like(room, distortion):
    camera = Camera(320, 240, 262.5, 262.5, 159.5, 119.5, distortion)
    T_world_a, T_world_b = drive(np.array([2.0, 2.4]), seed=0)
    a, b = render(room, camera, T_world_a), render(room, camera, T_world_b)
    points_b = se3.transform(se3.inverse(T_world_b), world_points(camera, a.depth_m, T_world_a))
    pixels, _ = cv2.projectPoints(
        points_b, np.zeros(3), np.zeros(3), camera.matrix, np.array(distortion)
    )
    u, v = np.rint(pixels.reshape(-1, 2)).astype(int).T
    inside = (points_b[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    u, v = u[inside], v[inside]
    assert inside.mean() > 0.6
    depth_error_m = np.abs(b.depth_m[v, u] - points_b[inside, 2])
    colour_error = np.abs(a.rgb.reshape(-1, 3)[inside].astype(int) - b.rgb[v, u].astype(int)).mean(
        axis=1
    )
    visible = depth_error_m < 0.01  # the rest is hidden from b by something nearer, or an edge
    assert visible.mean() > 0.9
    assert np.median(colour_error[visible]) < 8.0


def test_a_seed_is_a_room(room):
    T_world_cam = drive(np.array([0.0]), seed=0)[0]
    here, again, elsewhere = (
        render(each, SMALL, T_world_cam) for each in (room, build_room(3), build_room(4))
    )
    assert np.array_equal(here.rgb, again.rgb) and np.array_equal(here.depth_m, again.depth_m)
    assert np.abs(here.rgb.astype(int) - elsewhere.rgb.astype(int)).mean() > 20


def test_walls_offer_features_everywhere_along_the_drive(room):
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    orb = cv2.ORB_create(1000)
    for T_world_cam in drive(np.arange(0.0, 12.0, 1.2), seed=0):
        grey = cv2.cvtColor(render(room, camera, T_world_cam).rgb, cv2.COLOR_RGB2GRAY)
        assert len(orb.detect(grey)) >= 600

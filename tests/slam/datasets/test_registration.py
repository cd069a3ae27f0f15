# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.datasets.registration import Registration, resized
from slam.types import Camera

SMALL = Camera(4, 3, 2.0, 2.0, 1.5, 1.0, depth_scale=1000.0)


def shifted(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def test_a_resized_camera_sees_the_same_corners() -> None:
    camera = Camera(1296, 968, 1170.0, 1172.0, 647.75, 483.75)
    small = resized(camera, 640, 480)
    for before, after, size, size_after, f, f_after in (
        (camera.cx, small.cx, 1296, 640, camera.fx, small.fx),
        (camera.cy, small.cy, 968, 480, camera.fy, small.fy),
    ):
        assert (-0.5 - before) / f == pytest.approx((-0.5 - after) / f_after)
        assert (size - 0.5 - before) / f == pytest.approx((size_after - 0.5 - after) / f_after)


def test_a_small_colour_image_is_the_mean_of_the_large_one() -> None:
    large = resized(SMALL, 8, 6)
    rgb = np.repeat(np.repeat(np.arange(36, dtype=np.uint8).reshape(3, 4, 3), 2, 0), 2, 1)
    rgb[::2] += 10
    small = Registration(large, SMALL, np.eye(4)).register_color(rgb)
    assert (small == np.arange(36).reshape(3, 4, 3) + 5).all()


def test_images_of_one_camera_stay_as_they_are() -> None:
    registration = Registration(SMALL, SMALL, np.eye(4))
    depth_m = np.ones((3, 4), np.float32)
    rgb = np.ones((3, 4, 3), np.uint8)
    assert registration.camera == SMALL
    assert registration.register_depth(depth_m) is depth_m
    assert registration.register_color(rgb) is rgb


def test_depth_moves_by_the_parallax_of_its_distance() -> None:
    registration = Registration(SMALL, SMALL, shifted(1.0))
    depth_m = np.zeros((3, 4), np.float32)
    depth_m[0, 0], depth_m[1, 1], depth_m[2, 3] = 2.0, 1.0, 2.0
    wanted = np.zeros((3, 4))
    wanted[0, 1], wanted[1, 3] = 2.0, 1.0  # 1 m aside is 1 px at 2 m, 2 px at 1 m; one leaves
    np.testing.assert_array_equal(registration.register_depth(depth_m), wanted)


def test_of_two_surfaces_in_one_pixel_the_nearest_is_seen() -> None:
    registration = Registration(SMALL, SMALL, shifted(1.0))
    depth_m = np.zeros((3, 4), np.float32)
    depth_m[0, 0], depth_m[0, 1] = 1.0, 2.0
    assert registration.register_depth(depth_m)[0].tolist() == [0.0, 0.0, 1.0, 0.0]
    assert registration.register_depth(depth_m[:, [1, 0, 2, 3]])[0].tolist() == [0.0, 2.0, 0.0, 1.0]


def test_what_lies_behind_the_colour_camera_is_not_seen() -> None:
    T_color_depth = np.eye(4)
    T_color_depth[2, 3] = -2.0
    depth_m = np.full((3, 4), 1.5, np.float32)
    assert (Registration(SMALL, SMALL, T_color_depth).register_depth(depth_m) == 0.0).all()


def test_another_focal_length_alone_moves_depth() -> None:
    wide = Camera(4, 3, 1.0, 1.0, 1.5, 1.0, depth_scale=1000.0)
    depth_m = np.arange(1.0, 13.0, dtype=np.float32).reshape(3, 4)
    moved = Registration(wide, SMALL, np.eye(4)).register_depth(depth_m)
    assert moved[1, 1:3].min() > 0.0
    assert (moved[:, [0, 3]] == 0.0).all()


def test_depth_that_is_off_by_a_pixel_at_the_edge_is_moved() -> None:
    color = Camera(100, 100, 100.0, 98.0, 49.5, 49.5, depth_scale=1000.0)
    depth = Camera(100, 100, 100.0, 100.0, 49.5, 49.5, depth_scale=1000.0)
    depth_m = np.repeat(np.arange(1.0, 101.0, dtype=np.float32)[:, None], 100, axis=1)
    moved = Registration(color, depth, np.eye(4)).register_depth(depth_m)
    assert (moved[0] == 0.0).all() and (moved[1] == 1.0).all() and (moved[50] == 51.0).all()

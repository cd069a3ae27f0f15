# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.geometry.features import straightened
from slam.types import Camera, Features

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, readout_s=0.03)
VELOCITY = np.array([0.4, 1.5, -0.8, 0.3, -0.2, 0.5])


@pytest.fixture
def points_m():
    """Return (N, 3) points all over the image, seen from the middle row's place."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([80.0, 80.0], [560.0, 400.0], (200, 2))
    depth_m = rng.uniform(0.8, 4.0, 200)
    rays = (pixels - [CAMERA.cx, CAMERA.cy]) / CAMERA.fx
    return np.column_stack([rays, np.ones(200)]) * depth_m[:, None]


def project(points_m):
    return points_m[:, :2] / points_m[:, 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]


def seen(points_m, velocity, camera=CAMERA):
    """Return the features of points by a camera that moves while its rows are read."""
    points_cam_m = points_m
    for _ in range(20):  # the row decides when, and when decides the row
        rows = project(points_cam_m)[:, 1]
        time_s = camera.readout_s * ((rows + 0.5) / camera.height - 0.5)
        T_mid_cam = np.array([se3.exp(velocity * t) for t in time_s])
        points_cam_m = np.array(
            [
                se3.transform(se3.inverse(T), p[None])[0]
                for T, p in zip(T_mid_cam, points_m, strict=True)
            ]
        )
    pixels = project(points_cam_m)
    zeros = np.zeros(len(pixels), np.int64)
    descriptors = np.zeros((len(pixels), 32), np.uint8)
    return Features(pixels, pixels, zeros, descriptors, points_cam_m[:, 2], points_cam_m)


def test_features_come_to_where_the_middle_row_would_have_seen_them(points_m):
    bent = seen(points_m, VELOCITY)
    straight = straightened(bent, CAMERA, VELOCITY)
    assert np.abs(bent.undistorted_px - project(points_m)).max() > 5.0
    np.testing.assert_allclose(straight.undistorted_px, project(points_m), atol=0.05)
    np.testing.assert_allclose(straight.points_m, points_m, atol=1e-3)
    np.testing.assert_array_equal(straight.depth_m, straight.points_m[:, 2])
    np.testing.assert_array_equal(straight.pixels, bent.pixels)  # where they are in the image


def test_what_has_no_depth_is_turned_and_stays_without(points_m):
    turning = np.array([*VELOCITY[:3], 0.0, 0.0, 0.0])
    bent = seen(points_m, turning)
    unknown = np.full(len(points_m), np.nan)
    flat = replace(bent, depth_m=unknown, points_m=np.column_stack([unknown] * 3))
    straight = straightened(flat, CAMERA, VELOCITY)
    np.testing.assert_allclose(straight.undistorted_px, project(points_m), atol=0.05)
    assert np.isnan(straight.depth_m).all() and np.isnan(straight.points_m).all()


def test_a_camera_at_rest_or_with_a_global_shutter_sees_straight(points_m):
    features = seen(points_m, np.zeros(6))
    for camera, velocity in ((CAMERA, np.zeros(6)), (replace(CAMERA, readout_s=0.0), VELOCITY)):
        straight = straightened(features, camera, velocity)
        np.testing.assert_allclose(straight.undistorted_px, features.undistorted_px, atol=1e-9)


def test_no_features_are_no_trouble(points_m):
    none = seen(points_m[:1], np.zeros(6))
    empty = Features(*(getattr(none, name)[:0] for name in none.__dataclass_fields__))
    assert len(straightened(empty, CAMERA, VELOCITY).pixels) == 0

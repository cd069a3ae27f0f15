# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.geometry.reprojection import CAUCHY, HUBER, Observations, project, robust_weights


def test_what_was_measured_is_expected_of_the_points_themselves(make_views):
    views = make_views(np.eye(4))
    index = np.arange(150)
    measured = Observations.of(views.reference, index, views.camera)
    residuals, _ = measured.residuals(views.reference.points_m, views.camera)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-9)
    assert measured.agree(views.reference.points_m, views.camera).all()


def test_derivatives_are_those_of_the_projection(make_views):
    camera = make_views(np.eye(4)).camera
    points_m = np.array([[0.1, -0.2, 1.5], [-0.4, 0.3, 2.5]])
    _, derivative = project(points_m, camera)
    for axis in range(3):
        nudge = 1e-6 * np.eye(3)[axis]
        change = project(points_m + nudge, camera)[0] - project(points_m - nudge, camera)[0]
        np.testing.assert_allclose(derivative[:, :, axis], change / 2e-6, rtol=1e-5, atol=1e-6)


def test_an_unknown_depth_says_nothing_and_coarse_levels_say_less(make_views):
    views = make_views(np.eye(4), 20)
    octaves = np.arange(20) % 3
    blind = replace(views.reference, depth_m=np.full(20, np.nan), octaves=octaves)
    measured = Observations.of(blind, np.arange(20), views.camera)
    shifted = views.reference.points_m + np.array([0.01, 0.0, 0.0])
    residuals, derivative = measured.residuals(shifted, views.camera)
    assert (residuals[:, 2] == 0.0).all() and (derivative[:, 2] == 0.0).all()
    expected_px = views.camera.fx * 0.01 / shifted[:, 2]
    np.testing.assert_allclose(residuals[:, 0], expected_px / 1.2**octaves)


def test_depth_is_believed_as_far_as_its_sensor_is_good(make_views):
    views = make_views(np.eye(4), 20)
    index = np.arange(20)
    usual = Observations.of(views.reference, index, views.camera)
    finer = Observations.of(views.reference, index, replace(views.camera, depth_noise_m=0.00025))
    np.testing.assert_array_equal(finer.sigma[:, :2], usual.sigma[:, :2])
    np.testing.assert_allclose(finer.sigma[:, 2], 0.1 * usual.sigma[:, 2])
    # On the finest level 25 mm at 1 m, as a disparity of a 0.075 m baseline.
    np.testing.assert_allclose(usual.sigma[:, 2], 0.025 * 0.075 * views.camera.fx)


def test_points_elsewhere_or_behind_do_not_agree(make_views):
    views = make_views(np.eye(4), 20)
    measured = Observations.of(views.reference, np.arange(20), views.camera)
    points_m = views.reference.points_m
    assert not measured.agree(points_m + np.array([0.1, 0.0, 0.0]), views.camera).any()
    behind = se3.transform(np.diag([-1.0, -1.0, -1.0, 1.0]), points_m)
    assert not measured.agree(behind, views.camera).any()


def huber(length):
    length = abs(length)
    return 0.5 * length**2 if length < HUBER else HUBER * (length - 0.5 * HUBER)


def cauchy(length):
    return 0.5 * CAUCHY**2 * np.log1p((length / CAUCHY) ** 2)


@pytest.mark.parametrize(("part", "cost"), [(0, huber), (1, huber), (2, cauchy)])
@pytest.mark.parametrize("length", [0.0, 0.5, 1.345, 3.0, 100.0])
def test_the_weight_of_a_residual_is_the_slope_of_its_cost(part, cost, length):
    weights = robust_weights(length * np.eye(3)[[part]])
    slope = (cost(length + 1e-6) - cost(length - 1e-6)) / 2e-6
    assert slope == pytest.approx(weights[0, part] * length, abs=1e-5)


def test_a_wrong_depth_loses_its_say_and_leaves_the_pixel_its_own(make_views):
    views = make_views(np.eye(4), 20)
    measured = Observations.of(views.reference, np.arange(20), views.camera)
    nearer = 0.1 * views.reference.points_m  # on the same ray
    residuals, _ = measured.residuals(nearer, views.camera)
    weights = robust_weights(residuals)
    assert weights[:, 2].max() < 0.05 and weights[:, :2].min() == 1.0
    assert measured.agree(nearer, views.camera).all()


def test_joined_and_selected_are_the_same_numbers(make_views):
    views = make_views(np.eye(4), 20)
    whole = Observations.of(views.reference, np.arange(20), views.camera)
    joined = Observations.joined([whole.select(np.arange(20) < 7), whole.select(np.arange(7, 20))])
    np.testing.assert_array_equal(joined.seen, whole.seen)
    np.testing.assert_array_equal(joined.sigma, whole.sigma)
    assert len(joined) == 20


def test_one_camera_can_stand_for_another(make_views):
    views = make_views(np.eye(4), 20)
    other = replace(views.camera, fx=300.0, fy=310.0, cx=200.0, cy=120.0)
    index, camera = np.arange(20), views.camera
    points_m = views.reference.points_m + np.array([0.01, 0.02, 0.1])
    measured = Observations.of(views.reference, index, camera)
    residuals, _ = measured.residuals(points_m, camera)
    as_other, _ = measured.seen_by(camera, other).residuals(points_m, other)
    np.testing.assert_allclose(as_other, residuals, rtol=1e-9)
    assert np.abs(measured.seen_by(camera, other).seen - measured.seen).max() > 50.0
    assert measured.seen_by(camera, replace(camera, width=9)) is measured

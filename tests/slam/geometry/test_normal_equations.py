# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.geometry.normal_equations import (
    add_as_query,
    add_as_reference,
    agreement,
    empty_equations,
    stepped,
)
from slam.geometry.reprojection import CAUCHY, HUBER, Observations, intrinsics

FAR = np.array([0.02, -0.01, 0.03, 0.05, -0.02, 0.04])


@pytest.fixture
def views(make_views):
    """Two views, of which some features have no depth."""
    made = make_views(se3.exp(np.array([0.05, 0.1, -0.02, 0.1, 0.05, -0.03])))
    depth_m = made.query.depth_m.copy()
    depth_m[::3] = np.nan
    return made._replace(query=replace(made.query, depth_m=depth_m))


def measured(features, camera):
    return Observations.of(features, np.arange(len(features.pixels)), camera)


def as_query(views, T):
    seen, equations = measured(views.query, views.camera), empty_equations()
    points_m = views.reference.points_m.astype(np.float64)
    mask = np.ones(len(points_m), bool)
    add_as_query(T, points_m, seen.seen, seen.sigma, mask, intrinsics(views.camera), *equations)
    return equations


def as_reference(views, T):
    seen, equations = measured(views.reference, views.camera), empty_equations()
    points_m = views.query.points_m.astype(np.float64)
    add_as_reference(T, points_m, seen.seen, seen.sigma, intrinsics(views.camera), *equations)
    return equations


def robust_cost(residuals):
    lengths = np.linalg.norm(residuals[:, :2], axis=1)
    of_pixels = np.where(lengths < HUBER, 0.5 * lengths**2, HUBER * (lengths - 0.5 * HUBER))
    of_depths = 0.5 * CAUCHY**2 * np.log1p((residuals[:, 2] / CAUCHY) ** 2)
    return (of_pixels + of_depths).sum()


def cost_as_query(views, T):
    points_m = se3.transform(se3.inverse(T), views.reference.points_m.astype(np.float64))
    return robust_cost(measured(views.query, views.camera).residuals(points_m, views.camera)[0])


def cost_as_reference(views, T):
    points_m = se3.transform(T, views.query.points_m.astype(np.float64))
    seen = measured(views.reference, views.camera)
    return robust_cost(seen.residuals(points_m, views.camera)[0])


@pytest.mark.parametrize(
    ("equations", "cost"), [(as_query, cost_as_query), (as_reference, cost_as_reference)]
)
def test_the_gradient_is_how_the_robust_cost_grows(views, equations, cost):
    T = views.T_ref_query @ se3.exp(FAR)
    hessian, gradient = equations(views, T)
    for axis, found in enumerate(gradient):
        nudge = 1e-6 * np.eye(6)[axis]
        change = cost(views, T @ se3.exp(nudge)) - cost(views, T @ se3.exp(-nudge))
        assert found == pytest.approx(change / 2e-6, rel=1e-4, abs=1e-2)
    np.testing.assert_allclose(hessian, hessian.T)
    assert np.linalg.eigvalsh(hessian)[0] > 0.0


def test_a_point_beyond_the_mask_and_one_that_is_unknown_say_nothing(views):
    T = views.T_ref_query
    seen = measured(views.query, views.camera)
    points_m = views.reference.points_m.astype(np.float64)
    mask = np.arange(len(points_m)) % 2 == 0
    unknown = np.where(mask[:, None], points_m, np.nan)
    some, others = empty_equations(), empty_equations()
    known = (seen.seen, seen.sigma)
    add_as_query(T, points_m, *known, mask, intrinsics(views.camera), *some)
    add_as_query(T, unknown, *known, np.ones(len(mask), bool), intrinsics(views.camera), *others)
    for a, b in zip(some, others, strict=True):
        np.testing.assert_array_equal(a, b)


def test_agreement_is_that_of_observations(views):
    T = views.T_ref_query @ se3.exp(0.1 * FAR)
    seen = measured(views.query, views.camera)
    points_m = views.reference.points_m.astype(np.float64)
    points_m[5] = views.T_ref_query[:3, 3] - [0.0, 0.0, 1.0]  # behind the camera
    mask = np.zeros(len(points_m), bool)
    agreement(T, points_m, seen.seen, seen.sigma, intrinsics(views.camera), mask)
    expected = seen.agree(se3.transform(se3.inverse(T), points_m), views.camera)
    np.testing.assert_array_equal(mask, expected)
    assert 0 < np.count_nonzero(mask) < len(mask)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 3.0])
def test_a_step_goes_where_the_equations_are_solved(size):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    hessian, gradient = root @ root.T + np.eye(6), rng.normal(size=6)
    gradient *= size / np.linalg.norm(np.linalg.solve(hessian, gradient))
    start = se3.exp(FAR)
    moved, step = stepped(start, hessian, gradient)
    np.testing.assert_allclose(step, -np.linalg.solve(hessian, gradient), rtol=1e-9)
    np.testing.assert_allclose(moved, start @ se3.exp(step), rtol=0.0, atol=1e-14)

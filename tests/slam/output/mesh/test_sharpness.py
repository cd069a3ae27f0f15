# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.output.mesh.sharpness import surroundings


def wall(rng, z_m=0.0, noise_m=0.002, count=3000):
    x, y = rng.uniform(0.0, 1.0, (2, count))
    return np.column_stack([x, y, z_m + rng.normal(0.0, noise_m, count)])


def about(points_m, radius_m=0.1):
    return surroundings(points_m, np.arange(0, len(points_m), 7), radius_m)


def test_a_single_wall_is_sharper_than_a_double_one_of_as_many_points():
    rng = np.random.default_rng(0)
    single = about(np.concatenate([wall(rng), wall(rng)]))
    double = about(np.concatenate([wall(rng), wall(rng, 0.03)]))
    assert single.entropies.mean() < double.entropies.mean() - 0.5
    assert np.sqrt(single.plane_variances_m2.mean()) == pytest.approx(0.002, rel=0.05)
    assert np.sqrt(double.plane_variances_m2.mean()) == pytest.approx(0.015, rel=0.1)


def test_the_entropy_is_that_of_a_normal_distribution():
    points_m = np.random.default_rng(1).normal(0.0, (0.1, 0.2, 0.3), (2000, 3))
    found = surroundings(points_m, np.arange(3), 10.0)  # all are within reach
    C = np.cov(points_m.T, bias=True)
    expected = 0.5 * np.log(np.linalg.det(2.0 * np.pi * np.e * C))
    np.testing.assert_allclose(found.entropies, expected)
    np.testing.assert_allclose(found.plane_variances_m2, np.linalg.eigvalsh(C)[0])


def test_where_too_little_was_seen_nothing_is_known():
    lonely = np.array([[5.0, 5.0, 5.0]])
    points_m = np.concatenate([wall(np.random.default_rng(2)), lonely])
    found = surroundings(points_m, np.array([0, len(points_m) - 1]), 0.1)
    assert np.isfinite(found.entropies).tolist() == [True, False]
    assert len(surroundings(points_m, np.zeros(0, np.int64), 0.1).entropies) == 0


def test_points_that_coincide_have_a_finite_entropy():
    found = surroundings(np.ones((50, 3)), np.array([0]), 0.1)
    assert np.isfinite(found.entropies).all()

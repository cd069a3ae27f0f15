# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.geometry.reprojection import Observations
from slam.geometry.triangulation import triangulate

ASIDE = se3.exp(np.array([0.0, -0.1, 0.02, 0.3, 0.05, 0.02]))


def blind(features):
    unknown = np.full_like(features.depth_m, np.nan)
    return replace(features, depth_m=unknown, points_m=np.full_like(features.points_m, np.nan))


def seen_twice(make_views, T_ref_query=ASIDE, **options):
    """Return both views' observations without depth, in the reference's order, and the views."""
    views = make_views(T_ref_query, 100, **options)
    order = [
        int(np.flatnonzero((views.query.descriptors == each).all(axis=1))[0])
        for each in views.reference.descriptors
    ]
    reference, query = blind(views.reference), blind(views.query)
    return (
        Observations.of(reference, np.arange(len(order)), views.camera),
        Observations.of(query, np.array(order), views.camera),
        views,
    )


def test_points_are_found_where_they_are(make_views):
    a, b, views = seen_twice(make_views)
    points_m, is_sound = triangulate(ASIDE, a, b, views.camera)
    assert is_sound.all()
    np.testing.assert_allclose(points_m, views.reference.points_m, atol=1e-6)


def test_noise_of_a_pixel_leaves_them_nearby(make_views):
    a, b, views = seen_twice(make_views, noise=0.5)
    points_m, is_sound = triangulate(ASIDE, a, b, views.camera)
    assert is_sound.mean() > 0.9
    error = points_m[is_sound, 2] / views.reference.points_m[is_sound, 2] - 1.0
    assert np.median(np.abs(error)) < 0.02 and np.abs(error).max() < 0.1


def test_what_does_not_lie_on_the_other_views_ray_is_not_believed(make_views):
    a, b, views = seen_twice(make_views, outliers=100)
    _, is_sound = triangulate(ASIDE, a, b, views.camera)
    assert is_sound[:100].all() and is_sound[100:].mean() < 0.05


def test_rays_that_meet_behind_the_cameras_are_not_believed(make_views):
    a, b, views = seen_twice(make_views)
    turned_back = ASIDE.copy()
    turned_back[:3, 3] *= -1.0
    _, is_sound = triangulate(turned_back, a, b, views.camera)
    assert not is_sound.any()


@pytest.mark.parametrize("turn", [0.0, 0.1])
def test_rays_that_hardly_meet_do_not_tell_a_depth(make_views, turn):
    T_ref_query = se3.exp(np.array([0.0, turn, 0.0, 0.002, 0.0, 0.0]))
    a, b, views = seen_twice(make_views, T_ref_query)
    _, is_sound = triangulate(T_ref_query, a, b, views.camera)
    assert not is_sound.any()


def test_a_camera_that_did_not_move_tells_no_depth(make_views):
    a, b, views = seen_twice(make_views, np.eye(4))
    points_m, is_sound = triangulate(np.eye(4), a, b, views.camera)
    assert not is_sound.any() and np.isfinite(points_m).all()


def test_coarse_features_need_a_larger_angle(make_views):
    T_ref_query = se3.exp(np.array([0.0, 0.0, 0.0, 0.06, 0.0, 0.0]))
    a, b, views = seen_twice(make_views, T_ref_query)
    _, fine = triangulate(T_ref_query, a, b, views.camera)
    a, b = (replace(each, sigma=4.0 * each.sigma) for each in (a, b))
    _, coarse = triangulate(T_ref_query, a, b, views.camera)
    assert fine.all() and coarse.mean() < 0.1


@pytest.mark.parametrize("size", [0.01, 100.0])
def test_the_size_of_the_world_changes_nothing(make_views, size):
    a, b, views = seen_twice(make_views, noise=0.5)
    larger = ASIDE.copy()
    larger[:3, 3] *= size
    points_m, is_sound = triangulate(ASIDE, a, b, views.camera)
    larger_m, is_sound_there = triangulate(larger, a, b, views.camera)
    np.testing.assert_array_equal(is_sound_there, is_sound)
    np.testing.assert_allclose(larger_m, size * points_m)


def test_of_nothing_comes_nothing(make_views):
    a, b, views = seen_twice(make_views)
    none = np.zeros(0, dtype=np.int64)
    points_m, is_sound = triangulate(ASIDE, a.select(none), b.select(none), views.camera)
    assert points_m.shape == (0, 3) and is_sound.shape == (0,)

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.config import PYRAMID_SCALE
from slam.geometry import reprojection, se3
from slam.geometry.features import back_project, match
from slam.geometry.refinement import Correspondences, refine, residual_lengths

T_REF_QUERY = se3.exp(np.array([0.05, -0.08, 0.03, 0.12, -0.05, 0.08]))
NUDGE = np.array([0.01, -0.02, 0.015, 0.02, 0.03, -0.02])


def correspondences_of(views):
    pairs = match(views.reference, views.query, 64)
    return Correspondences.of(views.reference, views.query, pairs, views.camera)


def half_squares(views, T_ref_query):
    """Return half the sum of squared whitened residuals, written down a second time."""
    pairs = match(views.reference, views.query, 64)
    pair_of = {"reference": pairs[:, 0], "query": pairs[:, 1]}
    total = 0.0
    for this, other, T_this_other in (
        ("query", "reference", np.linalg.inv(T_ref_query)),
        ("reference", "query", T_ref_query),
    ):
        seen, shown = getattr(views, this), getattr(views, other)
        index, other_index = pair_of[this], pair_of[other]
        points = (
            np.column_stack([shown.points_m[other_index], np.ones(len(pairs))]) @ T_this_other.T
        )
        K, baseline_m = views.camera.matrix, reprojection._BASELINE_M
        pixels = (points[:, :3] @ K.T)[:, :2] / points[:, 2:3]
        disparity = baseline_m * K[0, 0] * (1.0 / points[:, 2] - 1.0 / seen.depth_m[index])
        sigma_px = reprojection._PIXEL_SIGMA_PX * PYRAMID_SCALE ** (seen.octaves[index])
        pixel_residuals = (pixels - seen.undistorted_px[index]) / sigma_px[:, None]
        total += 0.5 * np.nansum(pixel_residuals**2)
        disparity_sigma_px = 10.0 * views.camera.depth_noise_m * baseline_m * K[0, 0] * sigma_px
        total += 0.5 * np.nansum((disparity / disparity_sigma_px) ** 2)
    return total


def with_octaves(features, octaves):
    return replace(features, octaves=octaves)


def without_depth(features, mask):
    depth_m = np.where(mask, np.nan, features.depth_m)
    return replace(
        features, depth_m=depth_m, points_m=np.where(mask[:, None], np.nan, features.points_m)
    )


def test_the_exact_motion_is_found_from_a_poor_guess(make_views):
    views = make_views(T_REF_QUERY)
    found, _ = refine(T_REF_QUERY @ se3.exp(NUDGE), correspondences_of(views), views.camera)
    np.testing.assert_allclose(found, T_REF_QUERY, atol=1e-9)


def test_the_hessian_is_that_of_the_cost_in_a_right_tangent_rotation_first(make_views):
    views = make_views(T_REF_QUERY)
    octaves = np.arange(len(views.query.octaves)) % 4
    views = views._replace(query=with_octaves(views.query, octaves))
    _, hessian = refine(T_REF_QUERY, correspondences_of(views), views.camera)
    step = 1e-4
    basis = step * np.eye(6)

    def cost(tangent):
        return half_squares(views, T_REF_QUERY @ se3.exp(tangent))

    # Where all residuals vanish, the cost is its quadratic part.
    expected = np.array(
        [
            [
                (cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4 * step**2)
                for b in basis
            ]
            for a in basis
        ]
    )
    np.testing.assert_allclose(hessian, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


def test_the_hessian_tells_how_uncertain_the_motion_is(make_views):
    errors, predicted = [], []
    for seed in range(60):
        views = make_views(T_REF_QUERY, 80, noise=1.0, seed=seed)
        found, hessian = refine(T_REF_QUERY, correspondences_of(views), views.camera)
        errors.append(se3.log(se3.inverse(T_REF_QUERY) @ found))
        predicted.append(np.diag(np.linalg.inv(hessian)))
    ratio = np.std(errors, axis=0) / np.sqrt(np.mean(predicted, axis=0))
    assert (ratio > 0.4).all() and (ratio < 2.0).all()


def test_outliers_pull_little(make_views):
    clean = make_views(T_REF_QUERY, 100, noise=0.5)
    spoiled = make_views(T_REF_QUERY, 100, noise=0.5, outliers=10)
    found, _ = refine(T_REF_QUERY, correspondences_of(spoiled), spoiled.camera)
    best, _ = refine(T_REF_QUERY, correspondences_of(clean), clean.camera)
    assert se3.translation_norm(se3.inverse(best) @ found) < 0.02


def test_depth_may_be_missing_in_either_view(make_views):
    views = make_views(T_REF_QUERY)
    rng = np.random.default_rng(1)
    half_blind = views._replace(
        reference=without_depth(views.reference, rng.random(150) < 0.5),
        query=without_depth(views.query, rng.random(150) < 0.5),
    )
    found, hessian = refine(
        T_REF_QUERY @ se3.exp(NUDGE), correspondences_of(half_blind), views.camera
    )
    np.testing.assert_allclose(found, T_REF_QUERY, atol=1e-9)
    _, full_hessian = refine(T_REF_QUERY, correspondences_of(views), views.camera)
    assert (np.linalg.eigvalsh(full_hessian - hessian) > 0.0).all()


def test_matches_without_any_depth_say_nothing(make_views):
    views = make_views(T_REF_QUERY)
    blind = np.ones(150, bool)
    correspondences = correspondences_of(
        views._replace(
            reference=without_depth(views.reference, blind), query=without_depth(views.query, blind)
        )
    )
    found, hessian = refine(T_REF_QUERY, correspondences, views.camera)
    np.testing.assert_array_equal(found, T_REF_QUERY)
    assert np.abs(hessian).max() < 1e-5


def test_no_matches_leave_the_guess_as_it_is(make_views):
    views = make_views(T_REF_QUERY)
    none = correspondences_of(views).select(np.zeros(150, bool))
    found, _ = refine(T_REF_QUERY, none, views.camera)
    np.testing.assert_array_equal(found, T_REF_QUERY)


def test_residuals_are_lengths_in_pixels_of_the_finest_level(make_views):
    views = make_views(np.eye(4), 20)
    shifted = replace(views.query, undistorted_px=views.query.undistorted_px + np.array([3.0, 4.0]))
    views = views._replace(query=with_octaves(shifted, np.arange(20) % 2))
    pairs = match(views.reference, views.query, 64)
    correspondences = Correspondences.of(views.reference, views.query, pairs, views.camera)
    expected = np.where(pairs[:, 1] % 2 == 1, 5.0 / 1.2, 5.0)
    lengths = residual_lengths(np.eye(4), correspondences, views.camera)
    np.testing.assert_allclose(lengths, expected)


def test_a_wrong_depth_makes_no_residual_longer(make_views):
    views = make_views(T_REF_QUERY)
    pairs = match(views.reference, views.query, 64)
    wrong = replace(views.query, depth_m=1.3 * views.query.depth_m)
    correspondences = Correspondences.of(views.reference, wrong, pairs, views.camera)
    lengths = residual_lengths(T_REF_QUERY, correspondences, views.camera)
    np.testing.assert_allclose(lengths, 0.0, atol=1e-9)


def test_a_point_behind_the_camera_agrees_with_nothing(make_views):
    views = make_views(np.eye(4), 20)
    T_ref_query = np.eye(4)
    T_ref_query[2, 3] = 2.0  # walks past the nearer half of the points
    lengths = residual_lengths(T_ref_query, correspondences_of(views), views.camera)
    behind = views.reference.depth_m[match(views.reference, views.query, 64)[:, 0]] < 2.0
    assert 0 < behind.sum() < 20
    assert np.isinf(lengths[behind]).all() and np.isfinite(lengths[~behind]).all()


def test_selecting_is_the_same_as_matching_fewer(make_views):
    views = make_views(T_REF_QUERY, noise=0.5)
    mask = np.arange(150) < 60
    pairs = match(views.reference, views.query, 64)
    fewer = Correspondences.of(views.reference, views.query, pairs[mask], views.camera)
    np.testing.assert_array_equal(
        refine(T_REF_QUERY, correspondences_of(views).select(mask), views.camera)[0],
        refine(T_REF_QUERY, fewer, views.camera)[0],
    )


def test_one_point_seen_many_times_is_no_reason_to_fail(make_views):
    views = make_views(T_REF_QUERY, 12)
    pixels = np.tile([[100.0, 100.0]], (12, 1))
    depth_m = np.full(12, 2.0)
    points_m = back_project(pixels, depth_m, views.camera)
    reference = replace(views.reference, undistorted_px=pixels, depth_m=depth_m, points_m=points_m)
    same = views._replace(reference=reference, query=replace(reference))
    found, hessian = refine(np.eye(4), correspondences_of(same), views.camera)
    assert np.isfinite(found).all() and (np.linalg.eigvalsh(hessian) > -1e-3).all()


@pytest.mark.parametrize("axis", range(6))
def test_each_direction_of_motion_is_found_on_its_own(make_views, axis):
    tangent = np.zeros(6)
    tangent[axis] = 0.1
    views = make_views(se3.exp(tangent))
    found, _ = refine(np.eye(4), correspondences_of(views), views.camera)
    np.testing.assert_allclose(se3.log(found), tangent, atol=1e-9)

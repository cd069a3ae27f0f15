# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.config import VerificationConfig
from slam.geometry import se3
from slam.geometry.features import match
from slam.geometry.refinement import Correspondences, refine
from slam.geometry.relative_pose import (
    estimate_relative_pose,
)
from slam.types import Features, Rejection, RejectionReason, RelativePose

T_REF_QUERY = se3.exp(np.array([0.05, -0.08, 0.03, 0.12, -0.05, 0.08]))
CONFIG = VerificationConfig()


def estimate(views, config=CONFIG):
    return estimate_relative_pose(views.reference, views.query, views.camera, config)


def select(features, mask):
    return Features(**{name: values[mask] for name, values in vars(features).items()})


def rejection(views, config=CONFIG):
    outcome = estimate(views, config).outcome
    assert isinstance(outcome, Rejection)
    return outcome


def error_m_deg(found, views):
    error = se3.inverse(views.T_ref_query) @ found.T_ref_query
    return se3.translation_norm(error), np.degrees(se3.rotation_angle(error))


def test_two_views_may_be_of_two_cameras(make_views):
    views = make_views(T_REF_QUERY, noise=0.5)
    camera = views.camera
    other = replace(camera, width=320, height=200, fx=300.0, fy=310.0, cx=150.0, cy=90.0)
    points_m = views.reference.points_m
    pixels = np.column_stack([other.fx * points_m[:, 0], other.fy * points_m[:, 1]])
    pixels = pixels / points_m[:, 2:] + [other.cx, other.cy]
    reference = replace(views.reference, pixels=pixels, undistorted_px=pixels)
    seen = estimate_relative_pose(reference, views.query, camera, CONFIG, other)
    off_m, off_deg = error_m_deg(seen.outcome, views)
    assert off_m < 0.005 and off_deg < 0.1
    assert isinstance(
        estimate_relative_pose(views.query, reference, other, CONFIG, camera).outcome, RelativePose
    )
    alone = estimate_relative_pose(reference, views.query, camera, CONFIG).outcome
    assert error_m_deg(alone, views)[0] > 2 * off_m


@settings(max_examples=20, deadline=None)
@given(
    st.lists(st.floats(-0.15, 0.15), min_size=3, max_size=3),
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
)
def test_any_motion_is_found_and_takes_the_query_to_the_reference(make_views, turn, shift):
    views = make_views(se3.exp(np.array([*turn, *shift])))
    found = estimate(views).outcome
    assert isinstance(found, RelativePose)
    np.testing.assert_allclose(found.T_ref_query, views.T_ref_query, atol=1e-6)


def test_the_direction_is_p_ref_from_p_query(make_views):
    forward = np.eye(4)
    forward[2, 3] = 0.25  # the query stands ahead of the reference, where its origin is
    found = estimate(make_views(forward)).outcome
    np.testing.assert_allclose(found.T_ref_query @ [0, 0, 0, 1], [0, 0, 0.25, 1], atol=1e-6)


@pytest.mark.parametrize(("known", "used"), [(0, 150), (74, 150), (76, 76)])
def test_points_that_others_measured_take_the_place_of_depth(make_views, known, used):
    views = make_views(T_REF_QUERY)
    depth_m = np.where(np.arange(150) < known, views.reference.depth_m, np.nan)
    found = estimate(views._replace(reference=replace(views.reference, depth_m=depth_m)))
    assert len(found.pixels) == used
    error_m, error_deg = error_m_deg(found.outcome, views)
    assert error_m < 1e-5 and error_deg < 1e-3


@pytest.mark.parametrize("outliers", [0, 50, 250])
def test_noise_and_outliers_are_borne(make_views, outliers):
    views = make_views(T_REF_QUERY, 150, outliers=outliers, noise=0.7)
    verification = estimate(views)
    error_m, error_deg = error_m_deg(verification.outcome, views)
    assert error_m < 0.01 and error_deg < 0.3
    assert 120 <= verification.inlier_mask.sum() <= 150 + 0.1 * outliers


def test_the_motion_is_the_best_one_for_its_inliers(make_views):
    views = make_views(T_REF_QUERY, 150, outliers=50, noise=1.0)
    verification = estimate(views)
    pairs = match(views.reference, views.query, CONFIG.max_descriptor_distance)
    inliers = Correspondences.of(
        views.reference, views.query, pairs[verification.inlier_mask], views.camera
    )
    found = verification.outcome.T_ref_query
    better, _ = refine(found, inliers, views.camera)
    np.testing.assert_allclose(better, found, atol=1e-6)


def test_the_evidence_is_every_match_in_image_pixels(make_views):
    views = make_views(T_REF_QUERY, 100, outliers=40)
    verification = estimate(views)
    assert verification.pixels.shape == (140, 4) and verification.inlier_mask.shape == (140,)
    at_reference = {tuple(row): i for i, row in enumerate(views.reference.pixels)}
    rows = [at_reference[tuple(row[:2])] for row in verification.pixels]
    assert sorted(rows) == list(range(140))
    is_true = np.array(rows) < 100
    assert verification.inlier_mask[is_true].all()
    assert verification.inlier_mask[~is_true].sum() <= 3


def test_lens_distortion_is_in_the_evidence_but_not_in_the_motion(make_views):
    views = make_views(T_REF_QUERY)
    bent = views._replace(query=replace(views.query, pixels=views.query.pixels + 17.0))
    np.testing.assert_array_equal(
        estimate(bent).outcome.T_ref_query, estimate(views).outcome.T_ref_query
    )
    np.testing.assert_allclose(
        estimate(bent).pixels - estimate(views).pixels, np.tile([0.0, 0.0, 17.0, 17.0], (150, 1))
    )


def test_the_same_views_give_the_same_bits(make_views):
    views = make_views(T_REF_QUERY, 60, outliers=60, noise=1.0)
    first, second = estimate(views), estimate(views)
    np.testing.assert_array_equal(first.outcome.T_ref_query, second.outcome.T_ref_query)
    np.testing.assert_array_equal(first.outcome.information, second.outcome.information)
    np.testing.assert_array_equal(first.inlier_mask, second.inlier_mask)


def test_the_information_is_symmetric_and_positive_definite(make_views):
    for count in (30, 100, 1000):
        motion = estimate(make_views(T_REF_QUERY, count, noise=0.5)).outcome
        np.testing.assert_allclose(motion.information, motion.information.T, rtol=1e-6, atol=1e-3)
        assert (np.linalg.eigvalsh(motion.information) > 0.0).all()


def test_the_tangent_is_rotation_first(make_views):
    # The same pixels 200 times as far away: as sharp a rotation, but a vague translation.
    views = make_views(np.eye(4), noise=0.3)
    far = views._replace(
        reference=farther(views.reference, 200.0), query=farther(views.query, 200.0)
    )
    sigma = np.sqrt(np.diag(np.linalg.inv(estimate(far).outcome.information)))
    assert 5.0 * sigma[:3].max() < sigma[3:].min()


def farther(features, times):
    return replace(features, depth_m=times * features.depth_m, points_m=times * features.points_m)


def matches_without_depth(views, kept):
    known = np.where(np.arange(len(views.reference.depth_m)) < kept, 1.0, np.nan)
    depth_m, points_m = known * views.reference.depth_m, known[:, None] * views.reference.points_m
    return views._replace(reference=replace(views.reference, depth_m=depth_m, points_m=points_m))


def test_few_matches(make_views):
    expected = Rejection(RejectionReason.FEW_MATCHES, 19, 20)
    assert rejection(make_views(T_REF_QUERY, 19)) == expected
    # Only matches whose reference has depth count, for only they tie the pose.
    verification = estimate(matches_without_depth(make_views(T_REF_QUERY), 19))
    assert verification.outcome == expected
    assert verification.pixels.shape == (19, 4) and not verification.inlier_mask.any()


def test_descriptors_that_differ_too_much_do_not_match(make_views):
    views = make_views(T_REF_QUERY)
    inverted = replace(views.query, descriptors=~views.query.descriptors)
    assert rejection(views._replace(query=inverted)).measured == 0


@pytest.mark.parametrize("empty", ["reference", "query", "both"])
def test_a_blank_image_matches_nothing(make_views, empty):
    views = make_views(T_REF_QUERY)
    nothing = select(views.reference, np.zeros(150, bool))
    views = views._replace(
        reference=views.reference if empty == "query" else nothing,
        query=views.query if empty == "reference" else nothing,
    )
    assert rejection(views) == Rejection(RejectionReason.FEW_MATCHES, 0, 20)


def test_no_pose(make_views):
    outcome = rejection(make_views(T_REF_QUERY, 0, outliers=30))
    assert outcome == Rejection(RejectionReason.NO_POSE, 0, 25)


@pytest.mark.parametrize("agreeing", [5, 8, 20])
def test_the_evidence_counts_as_many_inliers_as_the_rejection(make_views, agreeing):
    views = make_views(T_REF_QUERY, agreeing, outliers=30)
    found = estimate(views)
    assert isinstance(found.outcome, Rejection)
    assert found.outcome.measured == np.count_nonzero(found.inlier_mask)


def test_few_inliers(make_views):
    outcome = rejection(make_views(T_REF_QUERY, 20, outliers=30))
    assert outcome.reason is RejectionReason.FEW_INLIERS
    assert 20 <= outcome.measured < outcome.needed == 25


def test_low_inlier_ratio(make_views):
    views = make_views(T_REF_QUERY, 60, outliers=90)
    outcome = rejection(views, VerificationConfig(min_inlier_ratio=0.5))
    assert outcome.reason is RejectionReason.LOW_INLIER_RATIO
    assert 0.4 <= outcome.measured < 0.45 and outcome.needed == 0.5


def test_narrow_support(make_views):
    outcome = rejection(make_views(T_REF_QUERY, 100, window_px=(60.0, 80.0)))
    assert outcome.reason is RejectionReason.NARROW_SUPPORT
    assert outcome.needed == 0.04
    assert outcome.measured == pytest.approx(60 * 80 / (640 * 480), rel=0.1)


def test_the_limits_are_inclusive(make_views):
    views = make_views(T_REF_QUERY, 30, outliers=30)
    inliers = int(estimate(views).inlier_mask.sum())
    for passes, limit in ((True, inliers), (False, inliers + 1)):
        outcome = estimate(views, VerificationConfig(min_inliers=limit)).outcome
        assert isinstance(outcome, RelativePose) == passes


@pytest.mark.parametrize("count", range(1, 8))
def test_hardly_any_matches_are_a_rejection_even_if_settings_allow_them(make_views, count):
    lenient = VerificationConfig(min_matches=1, min_inliers=1, min_support=0.0)
    outcome = estimate(make_views(T_REF_QUERY, count), lenient).outcome
    if count < 6:
        assert outcome == Rejection(RejectionReason.FEW_MATCHES, count, 6)
    else:
        assert isinstance(outcome, RelativePose)


@pytest.mark.parametrize("seed", range(5))
def test_points_in_one_place_or_line_or_without_depth_in_the_query_do_not_break_it(
    make_views, seed
):
    rng = np.random.default_rng(seed)
    views = make_views(T_REF_QUERY, 60, seed=seed)
    for spread in (0.0, 1e-9, 1e-3, 1.0):
        points_m = np.array([0.3, -0.2, 2.0]) + spread * rng.random((60, 1)) * [1.0, 0.5, 0.2]
        reference = replace(views.reference, points_m=points_m, depth_m=points_m[:, 2])
        query = replace(views.query, depth_m=np.full(60, np.nan), points_m=np.full((60, 3), np.nan))
        outcome = estimate(views._replace(reference=reference, query=query)).outcome
        assert outcome == Rejection(RejectionReason.NO_POSE, 0, CONFIG.min_inliers)

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam.geometry import reprojection, se3
from slam.geometry.reprojection import Observations
from slam.mapping.bundle_adjustment import Bundle, Motions, adjust, agreeing


def bundle_of(scene, fixed=1):
    cameras, points = len(scene.features), len(scene.points_m)
    everything = np.arange(points)
    measured = [Observations.of(each, everything, scene.camera) for each in scene.features]
    point_of, camera_of = (each.ravel() for each in np.mgrid[:points, :cameras])
    return Bundle(
        T_world_cam=scene.T_world_cam.copy(),
        is_fixed=np.arange(cameras) < fixed,
        points_m=scene.points_m.copy(),
        camera_of=camera_of,
        point_of=point_of,
        measured=Observations.joined(measured).select(camera_of * points + point_of),
    )


def shaken(bundle, seed=0):
    rng = np.random.default_rng(seed)
    T = bundle.T_world_cam.copy()
    for k in np.flatnonzero(~bundle.is_fixed):
        T[k] = T[k] @ se3.exp(rng.normal(0.0, 0.02, 6))
    points_m = bundle.points_m + rng.normal(0.0, 0.03, bundle.points_m.shape)
    return replace(bundle, T_world_cam=T, points_m=points_m)


@pytest.mark.parametrize("fixed", [1, 2])
def test_poses_and_points_are_found_from_poor_guesses(make_scene, fixed):
    scene = make_scene()
    found = adjust(shaken(bundle_of(scene, fixed)), scene.camera, 20)
    np.testing.assert_allclose(found.T_world_cam, scene.T_world_cam, atol=1e-5)
    np.testing.assert_allclose(found.points_m, scene.points_m, atol=1e-4)
    np.testing.assert_array_equal(found.T_world_cam[:fixed], scene.T_world_cam[:fixed])


def test_it_ends_where_gtsam_ends(make_scene, monkeypatch):
    monkeypatch.setattr(reprojection, "HUBER", 1e6)
    monkeypatch.setattr(reprojection, "CAUCHY", 1e6)
    scene = make_scene(noise=0.8)
    bundle = bundle_of(scene)
    found = adjust(shaken(bundle), scene.camera, 50)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    baseline_m = reprojection._BASELINE_M
    c = scene.camera
    K = gtsam.Cal3_S2Stereo(c.fx, c.fy, 0.0, c.cx, c.cy, baseline_m)
    sigma = bundle.measured.sigma[0]
    # u, v and disparity are independent; GTSAM measures u, u - disparity, v
    A = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    noise = gtsam.noiseModel.Gaussian.Covariance(A @ np.diag(sigma**2) @ A.T)
    for k, T in enumerate(scene.T_world_cam):
        values.insert(k, gtsam.Pose3(T))
    for p, point in enumerate(scene.points_m):
        values.insert(100 + p, point)
    graph.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3(scene.T_world_cam[0])))
    for k, p, (u, v, d) in zip(
        bundle.camera_of, bundle.point_of, bundle.measured.seen, strict=True
    ):
        graph.add(
            gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(u, u - d, v), noise, k, 100 + p, K)
        )
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    expected = [optimum.atPose3(k).matrix() for k in range(len(scene.T_world_cam))]
    np.testing.assert_allclose(found.T_world_cam, expected, atol=1e-4)


def test_observations_that_contradict_the_rest_do_not_agree(make_scene):
    scene = make_scene(noise=0.3)
    bundle = bundle_of(scene)
    seen = bundle.measured.seen.copy()
    wrong = np.arange(len(seen)) % 29 == 0
    seen[wrong, 0] += 30.0
    bundle = replace(bundle, measured=Observations(seen, bundle.measured.sigma))
    found = adjust(bundle, scene.camera, 10)
    fits = agreeing(found, scene.camera)
    assert not fits[wrong].any() and fits[~wrong].mean() > 0.95
    again = adjust(found.select(fits), scene.camera, 10)
    error = se3.inverse(scene.T_world_cam) @ again.T_world_cam
    assert se3.translation_norm(error).max() < 0.004


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_the_size_of_the_world_changes_nothing(make_scene, size):
    scene = make_scene(noise=0.5)
    start = shaken(bundle_of(scene))
    measured = start.measured
    scaled = replace(
        start,
        T_world_cam=start.T_world_cam * np.array([1.0, 1.0, 1.0, size]),
        points_m=size * start.points_m,
        measured=replace(
            measured,
            seen=measured.seen / [1.0, 1.0, size],
            sigma=measured.sigma / [1.0, 1.0, size],
        ),
    )
    scaled.T_world_cam[:, 3, 3] = 1.0
    expected, found = (adjust(each, scene.camera, 20) for each in (start, scaled))
    np.testing.assert_allclose(found.points_m / size, expected.points_m, atol=1e-6)
    found_m, expected_m = found.T_world_cam[:, :3, 3] / size, expected.T_world_cam[:, :3, 3]
    np.testing.assert_allclose(found_m, expected_m, atol=1e-6)
    np.testing.assert_allclose(
        found.T_world_cam[:, :3, :3], expected.T_world_cam[:, :3, :3], atol=1e-6
    )


def test_a_camera_and_a_point_that_nobody_measured_stay(make_scene):
    scene = make_scene()
    bundle = bundle_of(scene)
    unseen = (bundle.camera_of != 4) & (bundle.point_of != 7)
    found = adjust(shaken(bundle).select(unseen), scene.camera, 5)
    start = shaken(bundle)
    np.testing.assert_allclose(found.T_world_cam[4], start.T_world_cam[4], atol=1e-9)
    np.testing.assert_allclose(found.points_m[7], start.points_m[7], atol=1e-9)


def test_the_same_bundle_gives_the_same_bits(make_scene):
    scene = make_scene(noise=0.5)
    one, other = (adjust(shaken(bundle_of(scene)), scene.camera, 5) for _ in range(2))
    np.testing.assert_array_equal(one.T_world_cam, other.T_world_cam)


def motions_of(T_world_cam, sigma):
    first, second = np.arange(len(T_world_cam) - 1), np.arange(1, len(T_world_cam))
    return Motions(
        first,
        second,
        se3.inverse(T_world_cam[first]) @ T_world_cam[second],
        np.tile(np.eye(6) / sigma**2, (len(first), 1, 1)),
    )


def test_motions_known_for_certain_are_kept_and_the_points_follow(make_scene):
    scene = make_scene(noise=0.8)
    bundle = bundle_of(scene)
    alone = adjust(shaken(bundle), scene.camera, 50)
    known = replace(shaken(bundle), motions=motions_of(scene.T_world_cam, 1e-6))
    found = adjust(known, scene.camera, 50)
    off_m, off_alone_m = (
        np.abs(each.T_world_cam - scene.T_world_cam)[:, :3, 3].max() for each in (found, alone)
    )
    assert off_m < 1e-5 < off_alone_m
    assert np.median(np.abs(found.points_m - scene.points_m)) < 0.02


def test_motions_that_say_next_to_nothing_change_next_to_nothing(make_scene):
    scene = make_scene(noise=0.8)
    bundle = bundle_of(scene)
    wrong = scene.T_world_cam @ se3.exp(
        np.random.default_rng(0).normal(0, 0.1, (len(scene.T_world_cam), 6))
    )
    vague = replace(shaken(bundle), motions=motions_of(wrong, 1e4))
    found, alone = (adjust(each, scene.camera, 50) for each in (vague, shaken(bundle)))
    np.testing.assert_allclose(found.T_world_cam, alone.T_world_cam, atol=1e-4)


@pytest.mark.parametrize("shared", [0, 1, 2])
def test_a_camera_that_nothing_holds_any_more_stays_finite(make_scene, shared):
    scene = make_scene(cameras=3)
    bundle = bundle_of(scene)
    others, alone = bundle.camera_of != 2, bundle.camera_of == 2
    chosen = (others & (bundle.point_of < 10)) | (alone & (bundle.point_of >= 10 - shared))
    seen = bundle.measured.seen.copy()
    seen[alone, 2] = np.nan  # without depth a point of its own says nothing
    bundle = replace(bundle, measured=Observations(seen, bundle.measured.sigma)).select(chosen)
    for seed in range(30):
        found = adjust(shaken(bundle, seed), scene.camera, 10)
        assert np.isfinite(found.T_world_cam).all() and np.isfinite(found.points_m).all()

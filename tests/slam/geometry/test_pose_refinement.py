# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.geometry.refinement import refine_pose
from slam.geometry.reprojection import Observations

NUDGE = np.array([0.01, -0.02, 0.015, 0.02, 0.03, -0.02])


def seen_by(scene, k, features=None):
    features = features or scene.features[k]
    return Observations.of(features, np.arange(len(features.pixels)), scene.camera)


def test_the_exact_pose_is_found_from_a_poor_guess(make_scene):
    scene = make_scene()
    guess = scene.T_world_cam[3] @ se3.exp(NUDGE)
    refined = refine_pose(guess, scene.points_m, seen_by(scene, 3), scene.camera)
    np.testing.assert_allclose(refined.T_world_cam, scene.T_world_cam[3], atol=1e-8)
    assert refined.inlier_mask.all()


def test_a_pose_is_found_without_any_depth(make_scene):
    scene = make_scene()
    blind = replace(scene.features[2], depth_m=np.full(120, np.nan))
    guess = scene.T_world_cam[2] @ se3.exp(NUDGE)
    refined = refine_pose(guess, scene.points_m, seen_by(scene, 2, blind), scene.camera)
    np.testing.assert_allclose(refined.T_world_cam, scene.T_world_cam[2], atol=1e-6)


def test_points_that_moved_are_told_apart(make_scene):
    scene = make_scene(noise=0.3)
    points_m = scene.points_m.copy()
    points_m[:20] += np.array([0.2, 0.1, 0.0])
    refined = refine_pose(scene.T_world_cam[1], points_m, seen_by(scene, 1), scene.camera)
    assert not refined.inlier_mask[:20].any() and refined.inlier_mask[20:].mean() > 0.95
    error = se3.inverse(scene.T_world_cam[1]) @ refined.T_world_cam
    assert se3.translation_norm(error) < 0.003


def test_the_hessian_tells_how_sure_the_pose_is(make_scene):
    few, many = make_scene(count=30), make_scene(count=120)
    traces = [
        np.trace(refine_pose(s.T_world_cam[0], s.points_m, seen_by(s, 0), s.camera).hessian)
        for s in (few, many)
    ]
    assert traces[1] / traces[0] == pytest.approx(4.0, rel=0.2)
    blank = few.features[0]
    none = Observations.of(blank, np.zeros(0, dtype=np.int64), few.camera)
    refined = refine_pose(few.T_world_cam[0], np.zeros((0, 3)), none, few.camera)
    np.testing.assert_array_equal(refined.T_world_cam, few.T_world_cam[0])

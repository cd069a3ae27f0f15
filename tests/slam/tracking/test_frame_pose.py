# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.config import VerificationConfig
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.tracking.frame_pose import View, agreed_pose, track_local_map
from slam.types import Frame, Rejection, RejectionReason

ALL = np.arange(120)
PAIRS = np.column_stack([ALL, ALL])


@pytest.fixture
def scene(make_scene):
    return make_scene()


@pytest.fixture
def the_map(scene):
    """Return a map of the first camera's 120 points, with its origin at that camera."""
    the_map = LandmarkMap(scene.camera, 8, 64)
    the_map.add_keyframe(scene.features[0], scene.T_world_cam[0], empty_pairs())
    the_map.add_landmarks(0)
    return the_map


@pytest.fixture
def view(scene):
    """Return what the third camera sees."""
    blank = Frame(0.0, np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32))
    return View(blank, scene.features[2], scene.camera)


def test_features_with_depth_are_counted(view):
    assert view.with_depth == 120
    view.features.depth_m[:7] = np.nan
    assert view.with_depth == 113


def test_the_share_of_the_image_that_features_cover_is_of_all_that_there_are(view):
    everything = np.arange(120)
    assert view.covered(everything) == 1.0
    assert view.covered(everything[:0]) == 0.0
    left = everything[view.features.undistorted_px[:, 0] < 320.0]
    assert 0.3 < view.covered(left) < 0.7
    assert view.covered(left[::2]) <= view.covered(left)


def test_the_pose_that_all_pairs_agree_on_is_found(the_map, view, scene):
    enough = VerificationConfig(min_matches=120, min_inliers=120)
    found = agreed_pose(the_map, view, PAIRS, enough)
    np.testing.assert_allclose(found, scene.T_world_cam[2], atol=1e-6)


def test_a_pose_needs_pairs_and_a_share_of_them_that_agrees(the_map, view):
    config = VerificationConfig(min_matches=121, min_inliers=20)
    few = Rejection(RejectionReason.FEW_MATCHES, 120, 121)
    assert agreed_pose(the_map, view, PAIRS, config) == few
    config = VerificationConfig(min_matches=4, min_inliers=121)
    few = Rejection(RejectionReason.FEW_INLIERS, 120, 121)
    assert agreed_pose(the_map, view, PAIRS, config) == few
    swapped = np.column_stack([ALL, np.roll(ALL, 1)])
    none = agreed_pose(the_map, view, swapped, VerificationConfig(min_inliers=20))
    assert isinstance(none, Rejection) and none.needed == 20 and none.measured < 20


def test_landmarks_around_refine_the_pose_and_enough_of_them_are_needed(the_map, view, scene):
    T_nearly = scene.T_world_cam[2].copy()
    T_nearly[0, 3] += 0.002
    config = VerificationConfig(min_inliers=20)
    found = track_local_map(the_map, view, T_nearly, ALL, config)
    np.testing.assert_allclose(found.T_map_cam, scene.T_world_cam[2], atol=1e-6)
    np.testing.assert_array_equal(found.pairs[:, 0], found.pairs[:, 1])
    count = len(found.pairs)
    assert count > 100 and np.linalg.eigvalsh(found.hessian)[0] > 0.0
    asked = VerificationConfig(min_inliers=count)
    assert len(track_local_map(the_map, view, T_nearly, ALL, asked).pairs) == count
    asked = VerificationConfig(min_inliers=count + 1)
    few = Rejection(RejectionReason.FEW_INLIERS, count, count + 1)
    assert track_local_map(the_map, view, T_nearly, ALL, asked) == few

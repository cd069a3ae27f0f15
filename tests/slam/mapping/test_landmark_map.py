# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.geometry.feature_grid import FeatureGrid
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.mapping.landmarks import UNSEEN


@pytest.fixture
def scene(make_scene):
    return make_scene()


def add(the_map, scene, k, pairs=None, T_map_cam=None):
    T_map_cam = scene.T_world_cam[k] if T_map_cam is None else T_map_cam
    pairs = empty_pairs() if pairs is None else pairs
    return the_map.add_keyframe(scene.features[k], T_map_cam, pairs)


@pytest.fixture
def one(scene):
    """Return a map of one keyframe, whose landmark i is point i."""
    the_map = LandmarkMap(scene.camera, 8, 64)
    the_map.add_landmarks(add(the_map, scene, 0))
    return the_map


def test_landmarks_lie_where_the_keyframe_saw_them(one, scene):
    np.testing.assert_allclose(one.landmarks.positions_m[:120], scene.points_m, atol=1e-9)
    np.testing.assert_array_equal(one.seen_by([0]), np.arange(120))


@pytest.mark.parametrize("k", [1, 4])
def test_a_search_finds_landmarks_from_elsewhere(one, scene, k):
    grid = FeatureGrid(scene.features[k], scene.camera)
    pairs = one.search(grid, scene.T_world_cam[k], np.arange(120), 3.0)
    assert len(pairs) > 100
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])


def test_a_camera_of_another_focal_length_finds_landmarks_on_another_level(one, scene):
    wide = replace(scene.camera, fx=0.5 * scene.camera.fx, fy=0.5 * scene.camera.fy)
    centre = np.array([wide.cx, wide.cy])
    pixels = centre + 0.5 * (scene.features[1].undistorted_px - centre)
    seen = replace(scene.features[1], pixels=pixels, undistorted_px=pixels)
    fine = replace(one.keyframes[0].features, octaves=np.full(120, 5))
    one.keyframes[0].features = fine
    one.landmarks.octaves[:120] = 5  # 1.2 ** 4 is about 2
    levels = replace(seen, octaves=np.full(120, 1))
    add(one, scene, 1)
    one.keyframes[1].features, one.keyframes[1].camera = levels, wide
    one.take_over(one.landmarks, one.keyframes)
    grid = FeatureGrid(levels, wide)
    pairs = one.search(grid, scene.T_world_cam[1], np.arange(120), 3.0)
    assert len(pairs) > 100
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])
    one.fuse(1, np.arange(120), 3.0)
    assert len(one.shared_features(0, 1)) > 100
    measured = one.measured(1)  # as the map's camera would have
    np.testing.assert_allclose(measured.seen[:, :2], scene.features[1].undistorted_px, atol=1e-9)


def test_what_is_behind_or_seen_from_the_back_is_not_looked_for(one, scene):
    grid = FeatureGrid(scene.features[0], scene.camera)
    turned = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert len(one.search(grid, turned, np.arange(120), 1000.0)) == 0
    beyond = turned.copy()
    beyond[2, 3] = 5.0  # in front of it all points, but all that is known is their other side
    assert len(one.search(grid, beyond, np.arange(120), 1000.0)) == 0


def test_however_close_a_landmark_is_it_is_found_and_its_depth_is_known(make_scene):
    scene = make_scene()
    small = [
        replace(each, depth_m=0.01 * each.depth_m, points_m=0.01 * each.points_m)
        for each in scene.features
    ]
    scene = scene._replace(features=small)
    the_map = LandmarkMap(scene.camera, 8, 64)
    ids = the_map.add_landmarks(add(the_map, scene, 0))
    grid = FeatureGrid(small[0], scene.camera)
    assert len(the_map.search(grid, scene.T_world_cam[0], ids, 3.0)) > 100
    T_map_cam = se3.from_rotation_translation(np.eye(3), np.array([0.0, 0.0, -1.0]))
    expected_m = 1.0 + np.median(small[0].depth_m)
    assert the_map.median_depth_m(T_map_cam, ids) == pytest.approx(expected_m)


def test_a_keyframe_that_created_no_landmark_moves_none(one, scene):
    second = add(one, scene, 1)
    before_m = one.landmarks.positions_m.copy()
    one.move_keyframes([second], scene.T_world_cam[2:3])
    np.testing.assert_array_equal(one.landmarks.positions_m, before_m)


def test_a_second_keyframe_adds_only_what_is_new(one, scene):
    pairs = np.tile(np.arange(100), (2, 1)).T
    second = add(one, scene, 1, pairs)
    made = one.add_landmarks(second)
    assert len(made) == 20 and len(one.landmarks) == 140
    assert one.covisible_keyframes(np.arange(120)) == [0, 1]
    assert one.covisible_keyframes(made) == [1]
    np.testing.assert_array_equal(one.shared_features(0, 1), pairs)


def test_fusing_makes_one_landmark_of_two_at_one_place(one, scene):
    made = one.add_landmarks(add(one, scene, 1))
    assert len(made) == 120 and len(one.shared_features(0, 1)) == 0
    one.fuse(0, made, 3.0)
    assert len(one.shared_features(0, 1)) > 110
    assert len(one.seen_by([0, 1])) < 130


def test_fusing_lets_a_keyframe_see_what_it_had_overlooked(one, scene):
    second = add(one, scene, 1)
    one.fuse(second, np.arange(120), 3.0)
    assert len(one.seen_by([second])) > 110
    assert one.covisible_keyframes(np.arange(120)) == [1, 0]  # the later of equals first


def test_what_a_keyframe_sees_already_is_not_looked_for_again(one, scene):
    scene.features[1].descriptors[119] = scene.features[1].descriptors[0]
    second = add(one, scene, 1, np.array([[0, 119]]))  # taken for another feature than it is
    one.fuse(second, np.arange(1), 3.0)
    assert one.keyframes[second].landmark_of[0] == UNSEEN and one.landmarks.sightings[0] == 2


def test_landmarks_where_nothing_fits_are_not_fused(one, scene):
    second = add(one, scene, 1)
    one.landmarks.positions_m[:60] += np.array([0.0, 0.1, 0.0])
    one.fuse(second, np.arange(120), 100.0)
    assert (one.keyframes[second].landmark_of[:60] == UNSEEN).all()
    assert (one.keyframes[second].landmark_of[60:] != UNSEEN).mean() > 0.9


def test_landmarks_are_carried_with_the_keyframe_that_made_them(one, scene):
    second = add(one, scene, 1, np.tile(np.arange(100), (2, 1)).T)
    made = one.add_landmarks(second)
    before = one.landmarks.positions_m[:140].copy()
    T_new_old = se3.exp(np.array([0.1, 0.0, 0.2, 1.0, 2.0, 3.0]))
    one.move_keyframes([second], np.array([T_new_old @ scene.T_world_cam[1]]))
    np.testing.assert_array_equal(one.landmarks.positions_m[:120], before[:120])
    expected = se3.transform(T_new_old, before[made])
    np.testing.assert_allclose(one.landmarks.positions_m[made], expected, atol=1e-9)


def test_a_copy_may_be_changed(one, scene):
    copied = one.copy()
    copied.add_landmarks(add(copied, scene, 1))
    copied.fuse(0, np.arange(120, 240), 3.0)
    copied.keyframes[0].landmark_of[:] = UNSEEN
    copied.landmarks.positions_m[:] = 0.0
    assert len(one.keyframes) == 1 and len(one.landmarks) == 120
    np.testing.assert_array_equal(one.seen_by([0]), np.arange(120))
    np.testing.assert_allclose(one.landmarks.positions_m[:120], scene.points_m, atol=1e-9)


def without_depth(scene, blind):
    """Return the scene with no camera having depth of the points in the mask."""
    return scene._replace(
        features=[
            replace(
                each,
                depth_m=np.where(blind, np.nan, each.depth_m),
                points_m=np.where(blind[:, None], np.nan, each.points_m),
            )
            for each in scene.features
        ]
    )


@pytest.fixture
def half_blind(scene):
    return without_depth(scene, np.arange(120) < 60)


def test_what_two_keyframes_see_without_depth_becomes_landmarks(half_blind):
    the_map = LandmarkMap(half_blind.camera, 8, 64)
    for k in (0, 2):
        the_map.add_landmarks(add(the_map, half_blind, k))
    assert len(the_map.seen_by([0])) == len(the_map.seen_by([1])) == 60
    made = the_map.triangulate(1, 0)
    assert len(made) == 60
    shown = the_map.keyframes[1].landmark_of[:60]
    np.testing.assert_array_equal(np.sort(shown), made)
    np.testing.assert_array_equal(the_map.keyframes[0].landmark_of[:60], shown)
    positions_m = the_map.landmarks.positions_m[shown]
    np.testing.assert_allclose(positions_m, half_blind.points_m[:60], atol=1e-6)
    assert (the_map.landmarks.sightings[made] == 2).all()
    assert len(the_map.triangulate(1, 0)) == 0


def test_a_triangulated_landmark_is_carried_with_the_keyframe_that_came_last(half_blind):
    the_map = LandmarkMap(half_blind.camera, 8, 64)
    for k in (0, 2):
        the_map.add_landmarks(add(the_map, half_blind, k))
    made = the_map.triangulate(1, 0)
    before_m = the_map.landmarks.positions_m[made].copy()
    aside = se3.from_rotation_translation(np.eye(3), np.array([0.5, 0.0, 0.0]))
    the_map.move_keyframes([1], [aside @ the_map.keyframes[1].T_map_cam])
    np.testing.assert_allclose(
        the_map.landmarks.positions_m[made] - before_m, [[0.5, 0.0, 0.0]] * 60
    )


def test_features_with_depth_or_a_landmark_are_not_triangulated(one, scene):
    second = add(one, scene, 2)
    assert len(one.triangulate(second, 0)) == 0


def test_a_keyframes_features_without_depth_lie_where_their_landmarks_do(half_blind):
    the_map = LandmarkMap(half_blind.camera, 8, 64)
    for k in (0, 2):
        the_map.add_landmarks(add(the_map, half_blind, k))
    measured = half_blind.features[2]
    np.testing.assert_array_equal(the_map.placed_features(1).points_m, measured.points_m)
    the_map.triangulate(1, 0)
    placed = the_map.placed_features(1)
    T_cam_world = se3.inverse(half_blind.T_world_cam[2])
    expected_m = se3.transform(T_cam_world, half_blind.points_m)
    np.testing.assert_allclose(placed.points_m, expected_m, atol=1e-6)
    np.testing.assert_array_equal(placed.depth_m, measured.depth_m)
    assert np.isnan(measured.points_m[:60]).all()

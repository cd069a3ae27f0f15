# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import se3
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.mapping.map_adjustment import adjust_with_loops


@pytest.fixture
def scene(make_scene):
    return make_scene(cameras=6, noise=0.2)


@pytest.fixture
def two_visits(scene):
    """Return a map of two visits to one place that share no landmark, and its poses.

    Within a visit the landmarks are shared; the second visit is 3 cm off.
    """
    the_map = LandmarkMap(scene.camera, 8, 64)
    off = se3.exp(np.array([0.0, 0.0, 0.0, 0.02, 0.02, 0.01]))
    T_map_kf = np.array([off @ T if k >= 3 else T for k, T in enumerate(scene.T_world_cam)])
    for k, (features, T) in enumerate(zip(scene.features, T_map_kf, strict=True)):
        pairs = np.column_stack([np.arange(120) + (120 if k > 3 else 0), np.arange(120)])
        pairs = empty_pairs() if k in (0, 3) else pairs
        the_map.add_keyframe(features, T, pairs)
        the_map.add_landmarks(k)
    return the_map, T_map_kf


def errors_m(the_map, scene):
    T_map_kf = np.array([keyframe.T_map_cam for keyframe in the_map.keyframes])
    return se3.translation_norm(se3.inverse(scene.T_world_cam) @ T_map_kf)


def test_a_loop_ties_what_was_seen_twice(two_visits, scene):
    the_map, T_map_kf = two_visits
    nearer = T_map_kf.copy()
    nearer[3:, :3, 3] += 0.8 * (scene.T_world_cam - T_map_kf)[3:, :3, 3]  # the graph's solution
    closed = adjust_with_loops(the_map, range(6), nearer, [(2, 3)])
    assert errors_m(closed, scene).max() < 0.003
    assert len(closed.shared_features(0, 5)) > 100


def test_without_a_loop_nothing_is_tied(two_visits, scene):
    the_map, T_map_kf = two_visits
    closed = adjust_with_loops(the_map, range(6), T_map_kf, [])
    assert errors_m(closed, scene)[3:].min() > 0.02
    assert len(closed.shared_features(0, 5)) == 0


def test_the_trackers_map_stays_as_it_was(two_visits):
    the_map, T_map_kf = two_visits
    positions_m = the_map.landmarks.positions_m.copy()
    adjust_with_loops(the_map, range(6), T_map_kf, [(0, 5)])
    np.testing.assert_array_equal(the_map.landmarks.positions_m, positions_m)
    for keyframe, T in zip(the_map.keyframes, T_map_kf, strict=True):
        np.testing.assert_array_equal(keyframe.T_map_cam, T)


def test_a_keyframe_beyond_the_graph_is_left_out(two_visits):
    the_map, T_map_kf = two_visits
    closed = adjust_with_loops(the_map, range(5), T_map_kf[:5], [])
    np.testing.assert_array_equal(closed.keyframes[5].T_map_cam, T_map_kf[5])


def test_a_segment_that_was_turned_round_is_tied_all_the_same(scene):
    the_map = LandmarkMap(scene.camera, 8, 64)
    T_map_own = se3.exp(np.array([0.2, 2.5, 0.3, 3.0, -1.0, 2.0]))  # a gauge of its own
    T_map_kf = np.array([T_map_own @ T if k >= 3 else T for k, T in enumerate(scene.T_world_cam)])
    for k, (features, T) in enumerate(zip(scene.features, T_map_kf, strict=True)):
        pairs = np.column_stack([np.arange(120) + (120 if k > 3 else 0), np.arange(120)])
        pairs = empty_pairs() if k in (0, 3) else pairs
        the_map.add_keyframe(features, T, pairs)
        the_map.add_landmarks(k)
    closed = adjust_with_loops(the_map, range(6), scene.T_world_cam, [(2, 3)])
    assert errors_m(closed, scene).max() < 0.003
    assert len(closed.shared_features(0, 5)) > 100


def test_keyframes_without_a_place_stay_as_they_are(two_visits):
    the_map, T_map_kf = two_visits
    closed = adjust_with_loops(the_map, [3, 4, 5], T_map_kf[3:], [])
    for k in range(3):
        np.testing.assert_array_equal(closed.keyframes[k].T_map_cam, T_map_kf[k])
    assert len(closed.shared_features(2, 3)) == 0

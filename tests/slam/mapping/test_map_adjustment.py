# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import se3
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.mapping.landmarks import UNSEEN
from slam.mapping.map_adjustment import adjusted, extract_problem, write_back

ROUNDS = (5, 5)


@pytest.fixture
def scene(make_scene):
    return make_scene(noise=0.2)


@pytest.fixture
def the_map(scene):
    """Return a map of five keyframes, the later ones a little off, that all see each landmark.

    Keyframe 0 makes 100 landmarks, which the others find; what else each sees is its own.
    """
    built = LandmarkMap(scene.camera, 8, 64)
    rng = np.random.default_rng(2)
    for k, (features, T) in enumerate(zip(scene.features, scene.T_world_cam, strict=True)):
        shaken = T @ se3.exp(rng.normal(0.0, 0.01, 6)) if k else T
        pairs = np.tile(np.arange(100), (2, 1)).T if k else empty_pairs()
        built.add_keyframe(features, shaken, pairs)
        built.add_landmarks(k)
    return built


def errors_m(the_map, scene):
    T_map_cam = np.array([keyframe.T_map_cam for keyframe in the_map.keyframes])
    return se3.translation_norm(se3.inverse(scene.T_world_cam) @ T_map_cam)


def test_only_what_ties_keyframes_together_is_taken(the_map):
    part = extract_problem(the_map, [0, 1, 2, 3], [4])
    np.testing.assert_array_equal(part.landmark_ids, np.arange(100))
    assert part.keyframe_ids == (0, 1, 2, 3, 4)
    assert part.bundle.is_fixed.tolist() == [False] * 4 + [True]
    assert extract_problem(the_map, range(5), []).bundle.is_fixed.tolist() == [True] + [False] * 4
    assert len(part.fits) == 500 and part.fits.all()
    for k, p, f in zip(part.bundle.camera_of, part.bundle.point_of, part.feature_of, strict=True):
        assert the_map.keyframes[part.keyframe_ids[k]].landmark_of[f] == part.landmark_ids[p]


def test_taking_and_adjusting_leave_the_map_as_it_is(the_map):
    before = the_map.copy()
    adjusted(extract_problem(the_map, range(5), []), the_map.camera, ROUNDS)
    for one, other in zip(the_map.keyframes, before.keyframes, strict=True):
        np.testing.assert_array_equal(one.T_map_cam, other.T_map_cam)
        np.testing.assert_array_equal(one.landmark_of, other.landmark_of)
    np.testing.assert_array_equal(the_map.landmarks.positions_m, before.landmarks.positions_m)


def test_put_back_the_keyframes_are_where_they_were_in_truth(the_map, scene):
    assert errors_m(the_map, scene)[1:].min() > 0.004
    write_back(the_map, adjusted(extract_problem(the_map, range(5), []), the_map.camera, ROUNDS))
    assert errors_m(the_map, scene).max() < 0.003


def test_a_keyframes_own_landmarks_ride_on_it(the_map, scene):
    write_back(the_map, adjusted(extract_problem(the_map, range(5), []), the_map.camera, ROUNDS))
    for keyframe in the_map.keyframes[1:]:
        assert len(keyframe.created_ids) == 20
        found = the_map.landmarks.positions_m[keyframe.created_ids]
        assert np.abs(found - scene.points_m[100:]).max() < 0.05


def test_fixed_keyframes_stay(the_map):
    before = [keyframe.T_map_cam.copy() for keyframe in the_map.keyframes]
    write_back(
        the_map, adjusted(extract_problem(the_map, [3, 4], [0, 1, 2]), the_map.camera, ROUNDS)
    )
    moved = [
        not np.array_equal(keyframe.T_map_cam, T)
        for keyframe, T in zip(the_map.keyframes, before, strict=True)
    ]
    assert moved == [False] * 3 + [True] * 2


def test_what_does_not_fit_is_seen_no_more(the_map):
    keyframe = the_map.keyframes[2]
    keyframe.features.undistorted_px[:7, 0] += 40.0
    write_back(the_map, adjusted(extract_problem(the_map, range(5), []), the_map.camera, ROUNDS))
    assert (keyframe.landmark_of[:7] == UNSEEN).all()
    assert (keyframe.landmark_of[7:100] != UNSEEN).mean() > 0.9
    assert the_map.landmarks.sightings[:7].tolist() == [4] * 7

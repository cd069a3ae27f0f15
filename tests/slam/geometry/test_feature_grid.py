# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry.feature_grid import FeatureGrid


def search(scene, k, expected_px=None, radius_px=5.0, octaves=0.0, max_distance=64, ids=None):
    features = scene.features[k]
    ids = np.arange(len(features.pixels)) if ids is None else ids
    expected_px = features.undistorted_px[ids] if expected_px is None else expected_px
    return FeatureGrid(features, scene.camera).search(
        expected_px,
        np.full(len(ids), radius_px),
        np.full(len(ids), octaves),
        features.descriptors[ids],
        max_distance,
    )


def test_every_point_is_found_where_it_is(make_scene):
    scene = make_scene()
    pairs = search(scene, 0)
    np.testing.assert_array_equal(pairs[np.argsort(pairs[:, 0])], np.tile(np.arange(120), (2, 1)).T)


@pytest.mark.parametrize(("shift_px", "is_found"), [(4.9, True), (5.1, False), (500.0, False)])
def test_it_is_looked_for_only_within_the_radius(make_scene, shift_px, is_found):
    scene = make_scene()
    for direction in np.array([[1.0, 0.0], [0.0, -1.0], [-0.6, 0.8]]):
        expected_px = scene.features[0].undistorted_px + shift_px * direction
        assert len(search(scene, 0, expected_px)) == (120 if is_found else 0)


def test_a_wide_search_agrees_with_one_that_looks_everywhere(make_scene):
    scene = make_scene(noise=2.0)
    expected_px = scene.features[1].undistorted_px
    rng = np.random.default_rng(1)
    for radius_px in rng.uniform(10.0, 200.0, 5):
        found = {tuple(pair) for pair in search(scene, 0, expected_px, radius_px)}
        offset = scene.features[0].undistorted_px - expected_px
        near = np.flatnonzero((offset**2).sum(axis=1) <= radius_px**2)
        assert found == {(i, i) for i in near}


def test_other_levels_and_other_descriptors_are_passed_by(make_scene):
    scene = make_scene()
    assert len(search(scene, 0, octaves=1.4)) == 120
    assert len(search(scene, 0, octaves=1.6)) == 0
    spoiled = scene.features[0].descriptors.copy()
    spoiled[:, :9] ^= 255  # 72 bits differ
    grid = FeatureGrid(scene.features[0], scene.camera)
    px, radius = scene.features[0].undistorted_px, np.full(120, 5.0)
    assert len(grid.search(px, radius, np.zeros(120), spoiled, 71)) == 0
    assert len(grid.search(px, radius, np.zeros(120), spoiled, 72)) == 120


def test_a_feature_goes_to_the_point_that_resembles_it_most(make_scene):
    scene = make_scene()
    features = scene.features[0]
    twice = np.repeat(features.descriptors[:1], 2, axis=0)
    twice[0, 0] ^= 1
    expected_px = np.repeat(features.undistorted_px[:1], 2, axis=0)
    grid = FeatureGrid(features, scene.camera)
    pairs = grid.search(expected_px, np.full(2, 5.0), np.zeros(2), twice, 64)
    assert pairs.tolist() == [[1, 0]]


def test_nothing_is_found_among_nothing(make_scene):
    scene = make_scene()
    assert search(scene, 0, ids=np.zeros(0, dtype=np.int64)).shape == (0, 2)
    empty = make_scene(count=0)
    assert search(empty, 0).shape == (0, 2)
    grid = FeatureGrid(empty.features[0], scene.camera)
    features = scene.features[0]
    some = features.undistorted_px, np.full(120, 9.0), np.zeros(120), features.descriptors, 64
    assert grid.search(*some).shape == (0, 2)

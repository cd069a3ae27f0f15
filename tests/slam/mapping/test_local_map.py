# SPDX-License-Identifier: Apache-2.0
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from slam.config import Config
from slam.geometry import se3
from slam.geometry.feature_grid import FeatureGrid
from slam.mapping import landmarks
from slam.mapping import local_map as module
from slam.mapping.landmark_map import empty_pairs
from slam.mapping.local_map import LocalMap


@pytest.fixture
def scene(make_scene):
    return make_scene(cameras=6, noise=0.2)


def insert(local_map, scene, k, T_odom_cam=None):
    """Insert a keyframe as the tracker does, with what it finds nearby, and wait."""
    newest = insert_only(local_map, scene, k, T_odom_cam)
    local_map.settle()
    return newest


def insert_only(local_map, scene, k, T_odom_cam=None):
    grid = FeatureGrid(scene.features[k], scene.camera)
    T_odom_cam = scene.T_world_cam[k] if T_odom_cam is None else T_odom_cam
    pairs = empty_pairs()
    if k:
        pairs = local_map.whole.search(grid, T_odom_cam, local_map.nearby_ids, 8.0)
    return local_map.insert(scene.features[k], T_odom_cam, pairs)


def test_a_keyframe_a_little_off_is_put_right(scene):
    local_map = LocalMap(scene.camera, Config())
    for k in range(4):
        off = se3.exp(np.array([0.002, 0.0, 0.0, 0.004, 0.0, 0.0])) if k == 3 else np.eye(4)
        assert insert(local_map, scene, k, scene.T_world_cam[k] @ off) == k
    error = se3.inverse(scene.T_world_cam[3]) @ local_map.whole.keyframes[3].T_map_cam
    assert se3.translation_norm(error) < 0.002


def off(scene, k):
    return scene.T_world_cam[k] @ se3.exp(np.array([0.002, 0.0, 0.0, 0.004, 0.0, 0.0]))


def test_a_keyframe_stays_where_it_is_put_until_the_map_is_settled(scene):
    local_map = LocalMap(scene.camera, Config())
    insert(local_map, scene, 0)
    insert_only(local_map, scene, 1, off(scene, 1))
    time.sleep(0.2)  # more than enough for the adjustment
    np.testing.assert_array_equal(local_map.whole.keyframes[1].T_map_cam, off(scene, 1))
    assert local_map.settle() and not local_map.settle()
    error = se3.inverse(scene.T_world_cam[1]) @ local_map.whole.keyframes[1].T_map_cam
    assert se3.translation_norm(error) < 0.003


def test_the_map_is_settled_a_number_of_frames_after_a_keyframe(scene):
    local_map = LocalMap(scene.camera, Config())
    insert(local_map, scene, 0)
    insert_only(local_map, scene, 1, off(scene, 1))
    moved = [local_map.next_frame() for _ in range(module._FRAMES_BESIDE + 2)]
    assert [len(each) for each in moved] == [0] * (module._FRAMES_BESIDE - 1) + [2, 0, 0]
    T_new_old = moved[module._FRAMES_BESIDE - 1][1]
    there = local_map.whole.keyframes[1].T_map_cam
    np.testing.assert_allclose(T_new_old @ off(scene, 1), there, atol=1e-12)
    assert se3.translation_norm(se3.inverse(scene.T_world_cam[1]) @ there) < 0.003


def test_a_slow_adjustment_gives_the_same_bits(scene, monkeypatch):
    def run():
        local_map = LocalMap(scene.camera, Config())
        for k in range(5):
            insert(local_map, scene, k, off(scene, k))
        return local_map

    def slowly(*arguments):
        time.sleep(0.05)
        return adjusted(*arguments)

    fast, adjusted = run(), module.adjusted
    monkeypatch.setattr(module, "adjusted", slowly)
    slow = run()
    for one, other in zip(fast.whole.keyframes, slow.whole.keyframes, strict=True):
        np.testing.assert_array_equal(one.T_map_cam, other.T_map_cam)
        np.testing.assert_array_equal(one.landmark_of, other.landmark_of)
    np.testing.assert_array_equal(fast.nearby_ids, slow.nearby_ids)


def test_what_is_adjusted_is_taken_from_the_map_before_the_thread_begins(scene, monkeypatch):
    takers, extract_problem = [], module.extract_problem

    def watched(*arguments):
        takers.append(threading.current_thread())
        return extract_problem(*arguments)

    monkeypatch.setattr(module, "extract_problem", watched)
    local_map = LocalMap(scene.camera, Config())
    for k in range(2):
        insert(local_map, scene, k)
    assert takers == [threading.current_thread()] * 2


def test_landmarks_nearby_are_those_of_the_keyframe_and_its_company(scene):
    local_map = LocalMap(scene.camera, Config())
    assert local_map.nearby_ids.tolist() == []
    for k in range(3):
        insert(local_map, scene, k)
    np.testing.assert_array_equal(local_map.nearby_ids, local_map.whole.seen_by([0, 1, 2]))
    assert 110 < len(local_map.nearby_ids) < 150


def test_a_landmark_that_no_second_keyframe_sees_is_culled_after_its_chance(scene):
    local_map = LocalMap(scene.camera, Config())
    insert(local_map, scene, 0)
    lonely = local_map.whole.landmarks.add(np.array([[0.0, 0.0, 2.5]]), 0)
    features = scene.features[0]
    local_map.whole.keyframes[0].landmark_of[5] = lonely[0]
    local_map.whole.landmarks.see(
        lonely, 0, np.zeros(3), 255 - features.descriptors[:1], features.octaves[:1]
    )
    alive = []
    for k in range(1, 5):
        insert(local_map, scene, k)
        alive.append(bool(local_map.whole.landmarks.is_alive[lonely[0]]))
    assert alive == [True, True, False, False]
    assert lonely[0] not in local_map.nearby_ids


def test_the_first_keyframe_of_every_segment_stays_where_it_is(scene):
    local_map = LocalMap(scene.camera, Config())
    for k in range(6):
        grid = FeatureGrid(scene.features[k], scene.camera)
        pairs = empty_pairs()
        if k not in (0, 3):
            pairs = local_map.whole.search(grid, scene.T_world_cam[k], local_map.nearby_ids, 8.0)
        off = se3.exp(np.array([0.002, 0.0, 0.0, 0.004, 0.0, 0.0])) if pairs.size else np.eye(4)
        local_map.insert(scene.features[k], scene.T_world_cam[k] @ off, pairs)
        local_map.settle()
    for k in (0, 3):
        placed = local_map.whole.keyframes[k].T_map_cam
        np.testing.assert_array_equal(placed, scene.T_world_cam[k])
    assert not np.array_equal(local_map.whole.keyframes[5].T_map_cam, scene.T_world_cam[5] @ off)


def test_nobody_knows_a_landmark_whose_row_becomes_another(make_scene, monkeypatch):
    scene, rng = make_scene(cameras=12, noise=0.2), np.random.default_rng(0)
    for k, features in enumerate(scene.features):  # every third one is like no other
        descriptors = features.descriptors.copy()
        descriptors[::3] = rng.integers(0, 256, descriptors[::3].shape)
        scene.features[k] = replace(features, descriptors=descriptors)
    monkeypatch.setattr(landmarks, "_SPARE_ROWS", 0)
    local_map, given_up = LocalMap(scene.camera, Config()), 0
    table = local_map.whole.landmarks
    for k in range(12):
        insert(local_map, scene, k)
        unused = table._unused
        given_up += len(unused)
        for keyframe in local_map.whole.keyframes:
            assert not np.isin(keyframe.landmark_of, unused).any()
            assert not np.isin(keyframe.created_ids, unused).any()
        assert not table.is_alive[unused].any()
    alive = np.count_nonzero(table.is_alive)
    assert given_up > 200
    assert len(table) < 1.5 * alive

# SPDX-License-Identifier: Apache-2.0
import numpy as np

from placerec.datasets.pose_distance import pose_distance

LEVEL = (0.0, 0.0, 0.0, 1.0)


def test_distance_is_metres_plus_radians():
    turned = (0.0, np.sin(0.15), 0.0, np.cos(0.15))  # 0.3 rad about y
    back = (0.0, -np.sin(0.15), 0.0, -np.cos(0.15))  # the same turn, as its other quaternion
    positions_m = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 0.2]])
    poses = positions_m, np.array([LEVEL, turned, back])
    distance = pose_distance(*poses, *poses)
    expected = [[0.0, 5.3, 0.5], [5.3, 0.0, np.sqrt(25.04)], [0.5, np.sqrt(25.04), 0.0]]
    assert np.allclose(distance, expected, atol=1e-7)


def test_distance_is_the_same_in_any_world_frame():
    rng = np.random.default_rng(3)
    positions, quaternions = rng.normal(size=(5, 3)), rng.normal(size=(5, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    half_turn = np.array([1.0, -1.0, -1.0])  # about x: (x, y, z, w) becomes (w, -z, y, -x)
    turned = quaternions[:, [3, 2, 1, 0]] * [1.0, -1.0, 1.0, -1.0]
    moved = positions * half_turn + 7.0, turned
    distance = pose_distance(positions, quaternions, positions, quaternions)
    assert np.allclose(pose_distance(*moved, *moved), distance, atol=1e-6)
    some = pose_distance(positions[:2], quaternions[:2], positions, quaternions)
    assert np.array_equal(some, distance[:2])

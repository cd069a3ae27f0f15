# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import pnp, se3
from slam.geometry.pnp import pose_by_ransac
from slam.types import Camera

CAMERA = Camera(640, 480, 517.0, 516.0, 318.0, 255.0)


def seen(count, seed=0, noise_px=0.5):
    """Return T_world_cam, world points before the camera and the pixels that show them."""
    rng = np.random.default_rng(seed)
    points_m = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(0.5, 4.0, count)])
    points_m[:, :2] *= 0.5 * points_m[:, 2:]
    pixels = points_m[:, :2] / points_m[:, 2:] * [517.0, 516.0] + [318.0, 255.0]
    T_world_cam = se3.exp(rng.normal(0.0, 0.7, 6))
    pixels += noise_px * rng.standard_normal(pixels.shape)
    return T_world_cam, se3.transform(T_world_cam, points_m), pixels


def test_three_points_have_their_pose_among_the_solutions():
    for seed in range(300):
        T_world_cam, points_m, pixels = seen(3, seed, noise_px=0.0)
        rays, poses = (pixels - [318.0, 255.0]) / [517.0, 516.0], np.empty((4, 4, 4))
        count = pnp._poses_of_three(points_m, rays, np.arange(3), poses)
        errors = [np.abs(T @ T_world_cam - np.eye(4)).max() for T in poses[:count]]
        assert min(errors) < 1e-5, seed


@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.7])
def test_the_pose_that_most_agree_on_is_found_and_who_agrees(wrong):
    T_world_cam, points_m, pixels = seen(200)
    is_wrong = np.arange(200) < 200 * wrong
    pixels[is_wrong] = np.random.default_rng(1).uniform(0, 480, (is_wrong.sum(), 2))
    found, mask = pose_by_ransac(points_m, pixels, CAMERA, 3.0, 300)
    np.testing.assert_allclose(found, T_world_cam, atol=0.03)
    assert mask[~is_wrong].mean() > 0.9 and mask[is_wrong].sum() <= 5
    again, _ = pose_by_ransac(points_m, pixels, CAMERA, 3.0, 300)
    np.testing.assert_array_equal(found, again)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_three_pairs_and_fewer_prove_nothing(count):
    _, points_m, pixels = seen(count)
    assert pose_by_ransac(points_m, pixels, CAMERA, 3.0, 300) is None


def test_points_on_a_line_or_in_one_place_give_no_pose():
    _, points_m, pixels = seen(50)
    for where in (np.zeros(3), np.array([1.0, 2.0, 3.0])):
        along = np.arange(50.0)[:, None] * where + points_m[0]
        found = pose_by_ransac(along, np.tile(pixels[:1], (50, 1)), CAMERA, 3.0, 20)
        assert found is None or np.isfinite(found[0]).all()


def test_what_is_unknown_agrees_with_nothing():
    T_world_cam, points_m, pixels = seen(100)
    points_m[::4] = np.nan
    found, mask = pose_by_ransac(points_m, pixels, CAMERA, 3.0, 300)
    np.testing.assert_allclose(found, T_world_cam, atol=0.03)
    assert not mask[::4].any()

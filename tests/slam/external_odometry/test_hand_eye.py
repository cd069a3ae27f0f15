# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.external_odometry.hand_eye import misfit, solve_hand_eye
from slam.geometry import se3
from slam.types import Trajectory

ROTATION_NOISE_RAD, TRANSLATION_NOISE_M = 0.002, 0.003


def motions(body, T_base_cam, scale=1.0, lag=15, noise=0.0, seed=0):
    """Return the motions of a camera, and those of the body it is on in units of another size."""
    rng = np.random.default_rng(seed)
    B = se3.inverse(body.T_world_cam[:-lag]) @ body.T_world_cam[lag:]
    A = se3.inverse(T_base_cam) @ B @ T_base_cam
    sigmas = noise * np.repeat([ROTATION_NOISE_RAD, TRANSLATION_NOISE_M], 3)
    A = A @ se3.exp(rng.normal(0.0, 1.0, (len(A), 6)) * sigmas)
    B = B @ se3.exp(rng.normal(0.0, 1.0, (len(B), 6)) * sigmas)
    B[:, :3, 3] /= scale
    return A, B, np.ones(len(A))


def driven():
    """Return a body that drives and turns on a floor, about the vertical alone."""
    stamps_s = np.arange(0.0, 20.0, 1 / 30)
    yaw = 1.2 * np.sin(0.9 * stamps_s) + 0.3 * np.sin(2.3 * stamps_s)
    ways_m = np.cumsum((0.4 + 0.3 * np.sin(0.7 * stamps_s)) / 30)
    T = se3.exp(np.multiply.outer(yaw, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    T[1:, :2, 3] = np.cumsum(np.diff(ways_m)[:, None] * T[:-1, :2, 0], axis=0)
    return Trajectory(stamps_s, T)


def off(found, T_base_cam):
    """Return degrees and metres between a frame that was found and the true one."""
    T = se3.inverse(T_base_cam) @ found.T_base_cam
    return np.degrees(se3.rotation_angle(T)), found.T_base_cam[:3, 3] - T_base_cam[:3, 3]


@pytest.mark.parametrize("scale", [1.0, 0.3048, 2.0])
def test_frame_and_scale_are_found_where_the_body_turns_every_way(walk, T_base_cam, scale):
    found = solve_hand_eye(*motions(walk, T_base_cam, scale))
    turned_deg, moved_m = off(found, T_base_cam)
    assert turned_deg < 1e-3
    assert np.abs(moved_m).max() < 1e-4
    assert found.scale == pytest.approx(scale, rel=1e-4)
    assert found.misfit < 1e-3
    assert found.unexplained == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_with_noise_they_are_as_far_off_as_is_said(walk, T_base_cam, seed):
    found = solve_hand_eye(*motions(walk, T_base_cam, 1.2, noise=1.0, seed=seed))
    turned_deg, moved_m = off(found, T_base_cam)
    assert turned_deg < 0.1 and np.abs(moved_m).max() < 0.003
    assert turned_deg < 5.0 * np.degrees(found.rotation_sigma_rad)
    assert np.abs(moved_m).max() < 5.0 * found.arm_sigma_m
    assert abs(found.scale - 1.2) < 5.0 * found.scale_sigma
    assert 0.005 < found.misfit < 0.03


def test_more_noise_is_told_as_less_known(walk, T_base_cam):
    few, many = (solve_hand_eye(*motions(walk, T_base_cam, noise=each)) for each in (1.0, 8.0))
    for sigma in ("rotation_sigma_rad", "arm_sigma_m", "scale_sigma", "misfit"):
        assert 4.0 < getattr(many, sigma) / getattr(few, sigma) < 12.0


def test_a_motion_that_others_tell_too_counts_less(walk, T_base_cam):
    A, B, shares = motions(walk, T_base_cam, noise=1.0)
    whole, tenth = (solve_hand_eye(A, B, factor * shares) for factor in (1.0, 0.1))
    assert tenth.arm_sigma_m == pytest.approx(np.sqrt(10.0) * whole.arm_sigma_m, rel=0.05)


def test_a_robot_on_the_floor_tells_all_but_the_height_of_its_camera(T_base_cam):
    found = solve_hand_eye(*motions(driven(), T_base_cam, 1.1, noise=1.0))
    turned_deg, moved_m = off(found, T_base_cam)
    assert turned_deg < 0.3
    assert np.abs(moved_m[:2]).max() < 0.005
    assert found.scale == pytest.approx(1.1, abs=0.005)
    # Nothing tells the height, which is said.
    assert found.arm_sigma_m > 0.1
    assert abs(found.T_base_cam[2, 3]) < found.arm_sigma_m


def test_a_frame_that_is_given_is_kept(walk, T_base_cam):
    found = solve_hand_eye(*motions(walk, T_base_cam, 1.2, noise=1.0), T_base_cam=T_base_cam)
    np.testing.assert_array_equal(found.T_base_cam, T_base_cam)
    assert found.scale == pytest.approx(1.2, abs=0.005)
    assert found.rotation_sigma_rad == found.arm_sigma_m == 0.0 < found.scale_sigma


def test_a_scale_that_is_given_is_kept(walk, T_base_cam):
    A, B, shares = motions(walk, T_base_cam, 1.2, noise=1.0)
    right, wrong = (solve_hand_eye(A, B, shares, scale=each) for each in (1.2, 1.0))
    assert (right.scale, right.scale_sigma, wrong.scale) == (1.2, 0.0, 1.0)
    turned_deg, moved_m = off(right, T_base_cam)
    assert turned_deg < 0.1 and np.abs(moved_m).max() < 0.003
    assert wrong.misfit > 3.0 * right.misfit


def test_what_is_given_whole_is_only_measured(walk, T_base_cam):
    A, B, shares = motions(walk, T_base_cam, 1.2, noise=1.0)
    found = solve_hand_eye(A, B, shares, T_base_cam, 1.2)
    np.testing.assert_array_equal(found.T_base_cam, T_base_cam)
    assert (found.scale, found.scale_sigma, found.arm_sigma_m) == (1.2, 0.0, 0.0)
    assert found.misfit == misfit(A, B, T_base_cam, 1.2) < 0.03


def with_foreign(A, share, seed=5):
    """Replace a share of motions by those of somebody else."""
    rng = np.random.default_rng(seed)
    foreign = rng.random(len(A)) < share
    A = A.copy()
    A[foreign] = se3.exp(rng.normal(0.0, 0.5, (foreign.sum(), 6)))
    return A


def test_a_fifth_of_the_motions_may_be_wrong(walk, T_base_cam):
    A, B, shares = motions(walk, T_base_cam, 1.2, noise=1.0)
    found = solve_hand_eye(with_foreign(A, 0.2), B, shares)
    turned_deg, moved_m = off(found, T_base_cam)
    assert turned_deg < 0.2 and np.abs(moved_m).max() < 0.005
    assert found.scale == pytest.approx(1.2, abs=0.01)
    assert 0.1 < found.unexplained < 0.3


def test_two_frames_that_are_mixed_leave_many_motions_unexplained(walk, T_base_cam):
    A, B, shares = motions(walk, T_base_cam, noise=1.0)
    found = solve_hand_eye(with_foreign(A, 0.45), B, shares)
    assert 0.35 < found.unexplained < 0.7


def test_a_camera_that_stands_still_leaves_nothing_unexplained(walk, T_base_cam):
    still = walk.T_world_cam.copy()
    still[:] = still[300]
    stamps_s = walk.timestamps_s
    moving, standing = (
        motions(Trajectory(stamps_s, T), T_base_cam, noise=1.0) for T in (walk.T_world_cam, still)
    )
    both = [np.concatenate(pair) for pair in zip(moving, standing, strict=True)]
    assert solve_hand_eye(*both).unexplained < 0.02


def test_motions_of_another_body_leave_nearly_everything(walk, T_base_cam):
    A, B, shares = motions(walk, T_base_cam)
    assert solve_hand_eye(A, np.roll(B, 260, axis=0), shares).misfit > 0.7


def test_the_misfit_is_the_mean_of_what_is_left_of_turns_and_of_ways():
    A = se3.exp(np.tile([0.0, 0.0, 0.2, 0.0, 0.0, 0.0], (5, 1)))
    A[:, 0, 3] = 1.0
    B = A.copy()
    assert misfit(A, B, np.eye(4), 1.0) == pytest.approx(0.0, abs=1e-12)
    assert misfit(A, B, np.eye(4), 1.4) == pytest.approx(0.5 * 0.4)
    turned = se3.exp(np.tile([0.0, 0.0, 0.26, 0.0, 0.0, 0.0], (5, 1)))
    turned[:, 0, 3] = 1.0
    assert misfit(A, turned, np.eye(4), 1.0) == pytest.approx(0.5 * 0.3)

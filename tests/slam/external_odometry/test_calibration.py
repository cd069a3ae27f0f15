# SPDX-License-Identifier: Apache-2.0
from itertools import accumulate

import numpy as np
import pytest

from slam.config import OdometryConfig
from slam.external_odometry.advice import read
from slam.external_odometry.calibration import calibrate, with_parts
from slam.external_odometry.conventions import Convention
from slam.geometry import se3
from slam.types import Trajectory

AS_IT_IS = Convention()


@pytest.fixture(scope="module")
def tracked(walk_at, drifting):
    """Return where images have the camera, ten of them in a second, with drift."""
    return drifting(walk_at(np.arange(200) / 10.0), rad=8e-4, m=8e-4)


@pytest.fixture(scope="module")
def camera(walk_at, drifting):
    """Return where an odometry has it, with another drift, between other times and for longer."""
    return drifting(walk_at(np.arange(-25, 1030) / 50.0 + 0.007), seed=7)


def in_parts(tracked, given):
    """Return the calibration, and what parts of the run say each on its own."""
    return with_parts(calibrate([tracked], given, AS_IT_IS), [tracked], given, AS_IT_IS)


def off(found, expected):
    T = se3.inverse(expected.T_base_cam) @ found.convention.T_base_cam
    return np.degrees(se3.rotation_angle(T)), se3.translation_norm(T)


@pytest.mark.parametrize("is_mounted", [False, True], ids=["camera", "body"])
def test_a_reading_that_is_right_is_left_as_it_is(tracked, camera, T_base_cam, is_mounted):
    asked = Convention(T_base_cam, 1.2, 0.15, True, True) if is_mounted else AS_IT_IS
    found = calibrate([tracked], asked.as_given(camera), asked)
    np.testing.assert_array_equal(found.convention.T_base_cam, asked.T_base_cam)
    assert found.convention.scale == asked.scale
    assert found.convention.is_inverted is found.convention.is_w_first is is_mounted
    assert found.convention.time_offset_s == pytest.approx(asked.time_offset_s, abs=0.004)
    assert found.misfit == found.hand_eye.misfit < 0.03
    assert found.misfit_before < 0.03
    assert found.hand_eye.arm_sigma_m == found.hand_eye.scale_sigma == 0.0


@pytest.mark.parametrize(
    ("is_inverted", "is_w_first"), [(True, False), (False, True)], ids=["inverted", "w first"]
)
def test_the_direction_and_the_order_of_quaternions_are_found(
    tracked, camera, is_inverted, is_w_first
):
    expected = Convention(is_inverted=is_inverted, is_w_first=is_w_first)
    found = calibrate([tracked], expected.as_given(camera), AS_IT_IS)
    assert found.convention.is_inverted is is_inverted
    assert found.convention.is_w_first is is_w_first
    # The rest is as it was asked for: there is no need for a simple reading to be anything else.
    np.testing.assert_array_equal(found.convention.T_base_cam, np.eye(4))
    assert found.convention.scale == 1.0
    assert found.misfit < 0.03 < 1.0 < found.misfit_before


def test_the_frame_of_the_body_is_found_and_nothing_else_is_changed(tracked, camera, T_base_cam):
    expected = Convention(T_base_cam)
    found = calibrate([tracked], expected.as_given(camera), AS_IT_IS)
    turned_deg, moved_m = off(found, expected)
    assert turned_deg < 0.5 and moved_m < 0.01
    assert found.convention.scale == 1.0
    assert found.convention.time_offset_s == pytest.approx(0.0, abs=0.004)
    assert not found.convention.is_inverted and not found.convention.is_w_first
    assert found.misfit < 0.03


@pytest.mark.parametrize("late_s", [0.15, -0.3])
def test_a_clock_that_is_late_is_found_to_a_few_milliseconds(tracked, camera, late_s):
    found = calibrate([tracked], Convention(time_offset_s=late_s).as_given(camera), AS_IT_IS)
    assert found.convention.time_offset_s == pytest.approx(late_s, abs=0.004)
    np.testing.assert_array_equal(found.convention.T_base_cam, np.eye(4))
    assert found.convention.scale == 1.0
    assert found.misfit < 0.03 < 0.2 < found.misfit_before


def test_the_unit_is_found_where_the_frame_is_right(tracked, camera):
    found = calibrate([tracked], Convention(scale=1.2).as_given(camera), AS_IT_IS)
    assert found.convention.scale == pytest.approx(1.2, abs=0.01)
    assert found.hand_eye.scale_sigma < 0.01
    np.testing.assert_array_equal(found.convention.T_base_cam, np.eye(4))


@pytest.mark.parametrize("scale", [1.05, 0.95])
def test_another_unit_is_named_where_noisy_images_fit_the_one_asked_for_about_as_well(
    walk_at, drifting, camera, scale
):
    noisy = drifting(walk_at(np.arange(400) / 20.0), rad=4e-3, m=4e-3)
    found = calibrate([noisy], Convention(scale=scale).as_given(camera), AS_IT_IS)
    assert found.convention.scale == pytest.approx(scale, abs=0.01)
    assert "--odometry.scale" in read(OdometryConfig(), found).sentences[0]


@pytest.mark.parametrize("noise_m", [5e-3, 2e-2, 5e-2])
@pytest.mark.parametrize("seed", range(3))
def test_noise_makes_no_other_unit(tracked, walk_at, drifting, noise_m, seed):
    camera = drifting(walk_at(np.arange(-25, 1030) / 50.0 + 0.007), m=noise_m, seed=seed)
    assert calibrate([tracked], camera, AS_IT_IS).convention.scale == 1.0


def test_all_is_found_at_once_also_from_parts_that_are_each_in_a_frame_of_its_own(
    tracked, camera, T_base_cam
):
    first, second = slice(0, 90), slice(100, 200)
    parts = [
        Trajectory(tracked.timestamps_s[first], tracked.T_world_cam[first]),
        Trajectory(tracked.timestamps_s[second], T_base_cam @ tracked.T_world_cam[second]),
    ]
    expected = Convention(T_base_cam, 1.2, 0.15, is_inverted=True, is_w_first=True)
    found = calibrate(parts, expected.as_given(camera), AS_IT_IS)
    turned_deg, moved_m = off(found, expected)
    assert turned_deg < 0.5 and moved_m < 0.01
    assert found.convention.scale == pytest.approx(1.2, abs=0.01)
    assert found.convention.time_offset_s == pytest.approx(0.15, abs=0.004)
    assert found.convention.is_inverted and found.convention.is_w_first
    assert found.misfit < 0.03


def test_poses_of_another_recording_fit_in_no_reading(tracked, camera, walk_at):
    other = walk_at(camera.timestamps_s + 300.0).T_world_cam
    found = calibrate([tracked], Trajectory(camera.timestamps_s, other), AS_IT_IS)
    assert found is None or found.misfit > 0.5


def few(trajectory, count):
    return Trajectory(trajectory.timestamps_s[:count], trajectory.T_world_cam[:count])


def test_of_too_few_poses_or_images_nothing_can_be_told(tracked, camera):
    assert calibrate([tracked], few(camera, 29), AS_IT_IS) is None
    assert calibrate([few(tracked, 8)], camera, AS_IT_IS) is None
    assert calibrate([few(tracked, 1), few(tracked, 0)], camera, AS_IT_IS) is None
    assert calibrate([], camera, AS_IT_IS) is None


def test_poses_of_another_time_tell_nothing(tracked, camera):
    later = Trajectory(camera.timestamps_s + 500.0, camera.T_world_cam)
    assert calibrate([tracked], later, AS_IT_IS) is None


def test_a_camera_that_does_not_turn_tells_nothing():
    stamps_s = np.arange(200) / 10.0
    T = np.tile(np.eye(4), (200, 1, 1))
    T[:, :3, 3] = np.multiply.outer(np.sin(stamps_s), [1.0, 0.5, -0.3])
    straight = Trajectory(stamps_s, T)
    assert calibrate([straight], straight, AS_IT_IS) is None


@pytest.mark.parametrize("asked_s", [4.9, 5.0])
def test_a_clock_is_looked_for_around_the_one_that_is_set(tracked, camera, asked_s):
    late = Convention(time_offset_s=5.0).as_given(camera)
    found = calibrate([tracked], late, Convention(time_offset_s=asked_s))
    assert found.convention.time_offset_s == pytest.approx(5.0, abs=0.004)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_poses_of_two_bodies_do_well_on_either_side_of_a_split_alone(
    tracked, camera, T_base_cam, share
):
    T, change = camera.T_world_cam.copy(), int(share * len(camera))
    T[change:] = T[change:] @ se3.inverse(T_base_cam)
    found = in_parts(tracked, Trajectory(camera.timestamps_s, T))
    early, late = found.sides
    assert max(early.misfit, late.misfit) < 0.15
    apart = se3.inverse(early.T_base_cam) @ late.T_base_cam
    difference = se3.inverse(T_base_cam) @ apart
    assert np.degrees(se3.rotation_angle(difference)) < 5.0
    assert found.misfit_of_sides > 0.5
    assert not read(OdometryConfig(), found).fits


@pytest.mark.parametrize("outlier", [0.05, 0.3])
@pytest.mark.parametrize("first", [10, 100, 200])
def test_a_few_wrong_steps_do_not_make_poses_those_of_two_bodies(tracked, camera, first, outlier):
    steps = se3.inverse(camera.T_world_cam[:-1]) @ camera.T_world_cam[1:]
    wrong = slice(first, first + 40, 8)
    off_by = np.array([outlier, 0.0, outlier, 0.0, 3.0 * outlier, 0.0])
    steps[wrong] = steps[wrong] @ se3.exp(off_by)
    T = np.array(list(accumulate(steps, np.matmul, initial=camera.T_world_cam[0])))
    found = in_parts(tracked, Trajectory(camera.timestamps_s, T))
    assert found.sides
    assert found.misfit_of_sides < 0.3
    assert read(OdometryConfig(), found).fits


def test_the_sides_of_one_body_agree(tracked, camera):
    early, late = in_parts(tracked, camera).sides
    apart = se3.inverse(early.T_base_cam) @ late.T_base_cam
    assert np.degrees(se3.rotation_angle(apart)) < 2.0


def test_a_scale_that_drifts_is_seen_at_the_ends(tracked, camera):
    T = camera.T_world_cam
    steps = se3.inverse(T[:-1]) @ T[1:]
    steps[:, :3, 3] *= np.linspace(0.9, 1.1, len(steps))[:, None]
    poses = np.array(list(accumulate(steps, np.matmul, initial=T[0])))
    found = in_parts(tracked, Trajectory(camera.timestamps_s, poses))
    scales = [each.scale for each in found.ends]
    np.testing.assert_allclose(scales, [1.0 / 0.925, 1.0 / 1.075], rtol=0.02)


def test_nothing_is_said_of_the_ends_where_the_odometry_has_poses_of_one_alone(tracked, camera):
    half = len(camera) // 2
    later = Trajectory(camera.timestamps_s[half:], camera.T_world_cam[half:])
    found = in_parts(tracked, later)
    assert found.ends == ()
    assert found.hand_eye.misfit < 0.03

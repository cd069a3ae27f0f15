# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import se3
from slam.tracking.motion_model import MotionModel

STEP = np.array([0.0, 0.1, 0.0, 0.05, 0.0, 0.02])


@pytest.fixture
def model():
    """Return the model of a camera that turned by 0.1 rad and moved by 5 cm in 0.1 s."""
    model = MotionModel(segment=0, last_s=10.0)
    model.follow(10.1, se3.exp(STEP))
    return model


def test_the_speed_of_a_turn(model):
    assert model.follow(10.2, se3.exp(2.0 * STEP)) == pytest.approx(1.0)
    assert model.follow(10.6, se3.exp(3.0 * STEP)) == pytest.approx(0.25)


@pytest.mark.parametrize(("time_s", "steps"), [(10.2, 2.0), (10.15, 1.5), (10.3, 3.0)])
def test_the_last_step_goes_on_as_long_as_time_does(model, time_s, steps):
    np.testing.assert_allclose(model.predict(time_s), se3.exp(steps * STEP), atol=1e-9)


def test_no_step_goes_on_for_much_longer_than_it_took(model):
    np.testing.assert_allclose(model.predict(19.0), se3.exp(3.0 * STEP), atol=1e-9)
    model.follow(10.101, se3.exp(2.0 * STEP))  # stamped when it arrived, right behind the last
    np.testing.assert_allclose(model.predict(10.2), se3.exp(4.0 * STEP), atol=1e-9)


def test_a_camera_that_only_started_is_thought_to_stay():
    np.testing.assert_array_equal(MotionModel(segment=0, last_s=10.0).predict(10.1), np.eye(4))


def test_velocity_is_that_of_the_last_step_and_unknown_after_a_while(model):
    np.testing.assert_allclose(model.velocity(10.2, 0.03), STEP / 0.1)
    np.testing.assert_array_equal(model.velocity(10.5, 0.03), np.zeros(6))


def test_no_step_is_taken_to_be_shorter_than_an_image_takes(model):
    model.follow(10.101, se3.exp(2.0 * STEP))
    np.testing.assert_allclose(model.velocity(10.2, 0.03), STEP / 0.03, atol=1e-9)


def test_a_trail_is_cold_a_while_after_the_camera_was_lost(model):
    model.has_missed = True
    assert not model.is_cold(10.3) and model.is_cold(10.4)
    model.follow(10.4, se3.exp(STEP))
    assert not model.is_cold(10.7)


def test_a_slow_camera_is_not_lost_between_two_frames(model):
    model.follow(10.5, se3.exp(2.0 * STEP))
    assert not model.is_cold(11.3)  # one of its frames was dropped
    assert model.is_cold(11.9)


def test_a_camera_that_only_started_may_take_three_seconds_for_its_next_frame():
    model = MotionModel(segment=0, last_s=10.0)
    assert not model.is_cold(13.0) and model.is_cold(13.01)
    model.has_missed = True
    assert not model.is_cold(10.25) and model.is_cold(10.26)


def test_a_quarter_of_a_second_is_not_yet_too_long():
    model = MotionModel(segment=0, last_s=9.5)
    assert not model.is_followed
    model.follow(10.0, se3.exp(STEP))
    assert model.is_followed
    np.testing.assert_allclose(model.velocity(10.25, 0.03), STEP / 0.5, atol=1e-12)


def test_velocity_to_a_place_is_that_of_the_step_there(model):
    step = np.array([0.0, 0.02, 0.0, 0.01, 0.0, 0.0])
    T_odom_next, next_s = model.T_odom_last @ se3.exp(step), model.last_s + 0.05
    np.testing.assert_allclose(model.velocity_to(next_s, T_odom_next, 0.01), step / 0.05, atol=1e-9)
    np.testing.assert_allclose(model.velocity_to(next_s, T_odom_next, 0.1), step / 0.1, atol=1e-9)
    late_s = model.last_s + 0.3
    np.testing.assert_array_equal(model.velocity_to(late_s, T_odom_next, 0.01), np.zeros(6))

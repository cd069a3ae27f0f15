# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import se3

unit_vectors = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 3)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)
# Close to no turn and close to half a turn is where the formulas run out of digits.
small = st.integers(-12, -1).map(lambda exponent: 10.0**exponent)
angles_rad = st.one_of(
    st.just(0.0), small, small.map(lambda angle: np.pi - angle), st.floats(0.0, 3.14)
)
translations_m = st.tuples(*[st.floats(-10.0, 10.0)] * 3).map(np.array)


@st.composite
def tangents(draw):
    return np.concatenate([draw(angles_rad) * draw(unit_vectors), draw(translations_m)])


transforms = tangents().map(se3.exp)


def rotation_about(axis, angle_rad):
    return se3.exp(np.concatenate([angle_rad * np.asarray(axis), np.zeros(3)]))


@given(tangents())
def test_exp_gives_a_rigid_transform(tangent):
    T = se3.exp(tangent)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_array_equal(T[3], [0.0, 0.0, 0.0, 1.0])


@given(tangents())
def test_log_undoes_exp(tangent):
    np.testing.assert_allclose(se3.log(se3.exp(tangent)), tangent, atol=1e-6)


@given(transforms)
def test_exp_undoes_log(T):
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-6)


@given(unit_vectors, translations_m)
def test_exp_undoes_log_of_exactly_half_a_turn(axis, translation_m):
    T = se3.from_rotation_translation(2.0 * np.outer(axis, axis) - np.eye(3), translation_m)
    assert np.linalg.norm(se3.log(T)[:3]) == pytest.approx(np.pi)
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-6)


def test_exp_of_known_motions():
    quarter_turn = se3.exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(quarter_turn[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    # Half a circle of radius 1: forward speed pi, turning by pi, ends 2 m to the left.
    half_circle = se3.exp(np.array([0.0, 0.0, np.pi, np.pi, 0.0, 0.0]))
    np.testing.assert_allclose(half_circle[:3, 3], [0.0, 2.0, 0.0], atol=1e-15)


@given(tangents())
def test_quaternion_round_trip(tangent):
    rotation = se3.exp(tangent)[:3, :3]
    quaternion = se3.to_quaternion(rotation)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    assert quaternion[3] >= 0.0
    np.testing.assert_allclose(se3.from_quaternion(quaternion), rotation, atol=1e-12)


def test_quaternions_are_xyzw_and_may_have_any_length():
    half = np.sqrt(0.5)
    turn = rotation_about([0.0, 1.0, 0.0], np.pi / 2)
    np.testing.assert_allclose(se3.to_quaternion(turn[:3, :3]), [0.0, half, 0.0, half])
    stack = se3.from_quaternion(np.array([[0.0, 3.0, 0.0, 3.0], [0.0, 0.0, 0.0, -2.0]]))
    np.testing.assert_allclose(stack, [turn[:3, :3], np.eye(3)], atol=1e-15)


@given(st.lists(transforms, min_size=1, max_size=4))
def test_inverse_of_one_and_of_a_stack(several):
    stack = np.stack(several)
    inverses = se3.inverse(stack)
    np.testing.assert_allclose(inverses @ stack, np.tile(np.eye(4), (len(stack), 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(inverses[0], se3.inverse(stack[0]))


@given(unit_vectors, angles_rad)
def test_rotation_angle_is_accurate_from_none_to_half_a_turn(axis, angle_rad):
    T = rotation_about(axis, angle_rad)
    assert float(se3.rotation_angle(T)) == pytest.approx(angle_rad, abs=1e-14, rel=1e-9)


def test_sizes_of_a_stack():
    stack = np.stack([np.eye(4), rotation_about([1.0, 0.0, 0.0], 0.5)])
    stack[1, :3, 3] = [2.0, 3.0, 6.0]
    np.testing.assert_allclose(se3.rotation_angle(stack), [0.0, 0.5])
    np.testing.assert_allclose(se3.translation_norm(stack), [0.0, 7.0])


@given(transforms, translations_m)
def test_transform_takes_points_from_b_to_a(T_a_b, point_b):
    expected = (T_a_b @ np.append(point_b, 1.0))[:3]
    np.testing.assert_allclose(se3.transform(T_a_b, point_b[None])[0], expected, atol=1e-12)


def test_the_best_rotation_weighs_vectors_and_is_no_reflection():
    rng = np.random.default_rng(2)
    R = se3.exp(np.array([0.3, -1.2, 0.8, 0.0, 0.0, 0.0]))[:3, :3]
    a = rng.normal(size=(20, 3))
    b = a @ R.T
    b[0] = [9.0, 9.0, 9.0]
    weights = np.array([0.0, *[1.0] * 19])
    np.testing.assert_allclose(se3.rotation_between(a, b, weights), R, atol=1e-12)
    flat = a * [1.0, 1.0, 1e-3]
    mirrored = flat * [1.0, 1.0, -1.0]
    assert np.linalg.det(se3.rotation_between(flat, mirrored, np.ones(20))) == pytest.approx(1.0)


def test_the_mean_motion_takes_poses_to_others_and_evens_out_what_is_off():
    rng = np.random.default_rng(0)
    T_b_kf = se3.exp(rng.normal(size=(6, 6)))
    T_a_b = se3.exp(rng.normal(size=6))
    np.testing.assert_allclose(se3.mean_motion(T_b_kf, T_a_b @ T_b_kf), T_a_b, atol=1e-9)
    moved = T_a_b @ T_b_kf
    moved[0, :3, 3] += 0.6
    off = se3.mean_motion(T_b_kf, moved)
    np.testing.assert_allclose(off[:3, :3], T_a_b[:3, :3], atol=1e-9)
    np.testing.assert_allclose(off[:3, 3], T_a_b[:3, 3] + 0.1, atol=1e-9)

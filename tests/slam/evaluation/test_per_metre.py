# SPDX-License-Identifier: Apache-2.0
import numpy as np
from numpy.testing import assert_allclose

from slam.evaluation.per_metre import drift_per_metre
from slam.geometry import se3
from slam.types import Trajectory

NO_SESSIONS = np.empty(0)


def straight(count: int, step_m: float) -> Trajectory:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(count)
    return Trajectory(np.arange(float(count)), poses)


def test_a_path_that_is_too_long_by_a_hundredth_drifts_by_a_centimetre_per_metre() -> None:
    found = drift_per_metre(straight(50, 0.101), straight(50, 0.1), 0.1, NO_SESSIONS)
    assert np.isnan(found[:10]).all()
    assert_allclose(found[11:], 0.01, atol=1e-9)


def test_a_metre_is_looked_back_at_least() -> None:
    found = drift_per_metre(straight(20, 0.33), straight(20, 0.3), 0.1, NO_SESSIONS)
    assert np.isnan(found[:4]).all()
    assert_allclose(found[4:], 0.1)  # over 1.2 m


def test_where_the_estimate_lies_does_not_matter() -> None:
    moved = straight(50, 0.101)
    T = se3.exp(np.array([0.3, -0.5, 0.2, 4.0, 5.0, 6.0]))
    elsewhere = Trajectory(moved.timestamps_s, T @ moved.T_world_cam)
    truth = straight(50, 0.1)
    assert_allclose(
        drift_per_metre(elsewhere, truth, 0.1, NO_SESSIONS),
        drift_per_metre(moved, truth, 0.1, NO_SESSIONS),
        atol=1e-9,
    )


def test_nothing_is_said_over_the_break_between_two_sessions() -> None:
    found = drift_per_metre(straight(50, 0.1), straight(50, 0.1), 0.1, np.array([20.0]))
    assert np.isnan(found[20:30]).all()
    assert_allclose(found[31:], 0.0, atol=1e-9)


def test_nothing_is_said_without_truth() -> None:
    late = straight(5, 1.0)
    late = Trajectory(late.timestamps_s + 100.0, late.T_world_cam)
    assert np.isnan(drift_per_metre(straight(5, 1.0), late, 0.1, NO_SESSIONS)).all()

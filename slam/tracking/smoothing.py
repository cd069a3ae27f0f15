# SPDX-License-Identifier: Apache-2.0
"""All frames smoothed by how little a carried camera accelerates."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import spsolve

from slam.config import MotionConfig
from slam.geometry import se3
from slam.types import FloatArray, IntArray, Trajectory

# How well single frames are placed, per axis. What is taken out of fr1_desk and fr1_xyz has median
# lengths of 5 and 3 mm. A frame that is wildly wrong is not expected, and pulls at its neighbours.
_POSITION_SIGMA_M = 0.005
_ROTATION_SIGMA_RAD = 0.005
# Over a longer time without a frame nothing is known of the motion.
_LONGEST_GAP_S = 0.2
_SHORTEST_STEP_S = 1e-3  # of frames stamped as they arrive, in a burst, time tells nothing


def smoothed(
    trajectory: Trajectory, config: MotionConfig, session_starts_s: Sequence[float] = ()
) -> Trajectory:
    """Return the most probable trajectory of a camera whose velocity changes as slowly as expected.

    Each frame's place is a measurement with a standard deviation of 5 mm and 0.3 degrees, and each
    three frames in a row measure an acceleration of zero with those of the config. In effect what
    swings faster than about 2 Hz is taken for noise. Positions are along the three axes of the
    world; rotations are unit quaternions, whose second differences are, along the unit sphere, half
    the angular acceleration. Where a session starts, the camera may have been put elsewhere.
    """
    if len(trajectory) < 3:
        return trajectory
    sessions = np.searchsorted(session_starts_s, trajectory.timestamps_s, side="right")
    accelerations = _accelerations(trajectory.timestamps_s, sessions)
    T_world_cam = trajectory.T_world_cam.copy()
    T_world_cam[:, :3, 3] = _most_probable(
        trajectory.T_world_cam[:, :3, 3],
        accelerations * (_POSITION_SIGMA_M / config.acceleration_m_s2),
    )
    quaternions = _most_probable(
        _quaternions(trajectory.T_world_cam[:, :3, :3]),
        accelerations * (_ROTATION_SIGMA_RAD / config.angular_acceleration_rad_s2),
    )
    T_world_cam[:, :3, :3] = se3.from_quaternion(quaternions)  # of whatever length
    return Trajectory(trajectory.timestamps_s, T_world_cam)


def _accelerations(timestamps_s: FloatArray, sessions: IntArray) -> scipy.sparse.csr_array:
    """Return the (M, N) second differences in time of frames that follow each other closely."""
    steps_s = np.maximum(np.diff(timestamps_s), _SHORTEST_STEP_S)
    before_s, after_s = steps_s[:-1], steps_s[1:]
    is_close = np.maximum(before_s, after_s) <= _LONGEST_GAP_S
    first = np.flatnonzero(is_close & (sessions[2:] == sessions[:-2]))
    before_s, after_s = before_s[first], after_s[first]
    both_s = before_s + after_s
    weights = 2.0 * np.column_stack(
        [1.0 / (before_s * both_s), -1.0 / (before_s * after_s), 1.0 / (after_s * both_s)]
    )
    columns = first[:, None] + np.arange(3)
    rows = np.repeat(np.arange(len(first)), 3)
    shape = (len(first), len(timestamps_s))
    return scipy.sparse.csr_array((weights.ravel(), (rows, columns.ravel())), shape=shape)


def _most_probable(measured: FloatArray, differences: scipy.sparse.csr_array) -> FloatArray:
    """Return the (N, D) values with the smallest squared changes and weighted differences."""
    information = scipy.sparse.eye_array(len(measured)) + differences.T @ differences
    return np.asarray(spsolve(information.tocsc(), measured), np.float64)


def _quaternions(rotations: FloatArray) -> FloatArray:
    """Return the (N, 4) quaternions of rotations, each of the two that is nearer the one before."""
    quaternions = np.array([se3.to_quaternion(rotation) for rotation in rotations])
    turns_over = np.einsum("nd,nd->n", quaternions[1:], quaternions[:-1]) < 0.0
    signs = np.cumprod(np.where(turns_over, -1.0, 1.0))
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[:, None]])

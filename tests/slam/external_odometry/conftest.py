# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable

import numpy as np
import pytest

from slam.geometry import se3
from slam.types import FloatArray, Trajectory

_HERTZ = np.array([0.31, 0.23, 0.17, 0.13, 0.19, 0.29])
_PHASES = np.array([0.0, 1.0, 2.5, 0.7, 2.1, 1.3])
_SIZES = np.array([0.3, 0.4, 0.25, 0.9, 0.7, 0.5])  # rad, m


def walk_at_times(stamps_s: FloatArray) -> Trajectory:
    cycles = np.multiply.outer(stamps_s, _HERTZ) + _PHASES
    tangents = _SIZES * (np.sin(2.0 * np.pi * cycles) + 0.4 * np.sin(5.0 * np.pi * cycles + 1.0))
    T = se3.exp(np.concatenate([tangents[:, :3], np.zeros_like(tangents[:, 3:])], axis=1))
    T[:, :3, 3] = tangents[:, 3:]
    return Trajectory(stamps_s, T)


@pytest.fixture(scope="session")
def walk_at() -> Callable[[FloatArray], Trajectory]:
    """Return where a camera is at (N,) times that sways and turns about every axis."""
    return walk_at_times


@pytest.fixture(scope="session")
def walk() -> Trajectory:
    """Return 20 s of it, at 30 images in a second."""
    return walk_at_times(np.arange(600) / 30.0)


@pytest.fixture(scope="session")
def drifting() -> Callable[..., Trajectory]:
    """Return a maker of trajectories whose every step is off: 0.03 degrees and 0.5 mm."""

    def make(truth: Trajectory, rad: float = 5e-4, m: float = 5e-4, seed: int = 0) -> Trajectory:
        rng = np.random.default_rng(seed)
        T = truth.T_world_cam
        steps = se3.inverse(T[:-1]) @ T[1:]
        steps = steps @ se3.exp(rng.normal(0.0, [rad] * 3 + [m] * 3, (len(steps), 6)))
        poses = [T[0]]
        for step in steps:
            poses.append(poses[-1] @ step)
        return Trajectory(truth.timestamps_s, np.array(poses))

    return make


@pytest.fixture(scope="session")
def T_base_cam() -> FloatArray:
    """Return a camera that looks ahead and a little down, from the front of a robot."""
    R = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    down = se3.exp(np.array([-0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))[:3, :3]
    return se3.from_rotation_translation(R @ down, np.array([0.2, -0.05, 0.3]))

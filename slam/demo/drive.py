# SPDX-License-Identifier: Apache-2.0
"""How the demo's camera moves: round the middle of the room, twice, never quite the same way."""

import numpy as np

from slam.types import FloatArray

LAP_S = 12.0
_RADII_M = (0.8, 0.6)
_HEIGHT_M = 1.3
_AHEAD_RAD = 1.1  # the view is turned from straight outwards to the direction of travel


def drive(times_s: FloatArray, seed: int) -> FloatArray:
    """Return (N, 4, 4) T_world_cam of a hand-held camera walking ellipses about the origin.

    It walks some 0.4 m/s and turns some 30 degrees a second. The second lap runs 8 cm further out
    and 3 cm higher, and looks 6 degrees further ahead.
    """
    laps = times_s / LAP_S
    around = 2.0 * np.pi * laps
    second = _smooth_step((laps - 0.85) / 0.3)
    shake = _shake(times_s, np.random.default_rng([seed, 0xD21]))
    position = np.stack(
        [
            (_RADII_M[0] + 0.08 * second) * np.cos(around),
            (_RADII_M[1] + 0.08 * second) * np.sin(around),
            _HEIGHT_M + 0.03 * second + 0.05 * np.sin(1.7 * around),
        ],
        axis=-1,
    )
    yaw = around + _AHEAD_RAD + 0.1 * second + 0.08 * np.sin(2.3 * around)
    pitch = -0.12 + 0.06 * np.sin(1.3 * around)
    T_world_cam = np.tile(np.eye(4), (len(times_s), 1, 1))
    T_world_cam[:, :3, :3] = _looking(yaw + shake[0], pitch + shake[1], shake[2])
    T_world_cam[:, :3, 3] = position + 0.5 * shake[3:].T
    return T_world_cam


def _looking(yaw: FloatArray, pitch: FloatArray, roll: FloatArray) -> FloatArray:
    """Return (N, 3, 3) R_world_cam: z forward, y down, world z up; angles in rad."""
    zero = np.zeros_like(yaw)
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1
    )
    level = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=-1)
    below = np.cross(forward, level)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * level + s * below, c * below - s * level, forward], axis=-1)


def _shake(times_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (6, N) smooth small wobbles, a sum of slow sine waves of random phase."""
    hertz = rng.uniform(0.4, 1.8, (6, 4, 1))
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 4, 1))
    waves = np.sin(2.0 * np.pi * hertz * times_s + phase) / hertz
    return np.asarray(0.0035 * waves.sum(axis=1))


def _smooth_step(x: FloatArray) -> FloatArray:
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))

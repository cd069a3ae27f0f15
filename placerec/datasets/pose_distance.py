# SPDX-License-Identifier: Apache-2.0
"""How far apart two cameras are, and from where they are at different places (eq. 10)."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SAME_PLACE = 0.6
"""Metres plus radians below which two frames are of the same place."""
JUST_BEYOND = 1.0
"""Metres plus radians up to which a different place is a neighbour, most easily taken for it."""


def pose_distance(
    positions_m: FloatArray,
    quaternions: FloatArray,
    other_positions_m: FloatArray,
    other_quaternions: FloatArray,
) -> FloatArray:
    """Return the (N, M) distances of eq. 10: metres plus radians of T_i^-1 T_j.

    Args:
        positions_m: (N, 3) of the camera.
        quaternions: (N, 4) x y z w, unit length.
        other_positions_m: (M, 3), in the same world.
        other_quaternions: (M, 4).
    """
    # Row by row: the differences of all pairs at once would take three times the memory.
    metres = np.array([np.linalg.norm(each - other_positions_m, axis=1) for each in positions_m])
    half_cosines = np.minimum(np.abs(quaternions @ other_quaternions.T), 1.0)
    return np.asarray(metres + 2.0 * np.arccos(half_cosines))

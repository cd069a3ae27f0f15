# SPDX-License-Identifier: Apache-2.0
"""Loops that agree with each other pair by pair, as those of one place seen twice do.

Mangelson, Dominic, Eustice, Vasudevan: Pairwise Consistent Measurement Set Maximization (2018). Two
like corridors make such loops too, so to agree is no proof; it tells what has to be judged as one.
"""

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from slam.pose_graph.motion_system import MotionSystem
from slam.types import FloatArray, IntArray

_NEIGHBOURS = 8  # in the order of one end, then of the other: memory grows with the loops
_MOST_APART = 20  # keyframes, at either end: over longer detours anything may agree


def clusters(
    system: MotionSystem,
    T: FloatArray,
    chosen: NDArray[np.bool_],
    wide: float,
    most_apart: int = _MOST_APART,
) -> IntArray:
    """Return (C,) the number of the cluster of each of C chosen loops of L, by (K, 4, 4) poses.

    Two agree if the cycle through both and the short ways between their ends closes as far as their
    uncertainty and that of the links allow.
    """
    loops = np.flatnonzero(chosen)
    ends = system.loop_ends[loops]
    pairs = _near(ends)
    apart = np.abs(ends[pairs[:, 0]] - ends[pairs[:, 1]]).max(axis=1, initial=0)
    pairs = pairs[apart <= most_apart]
    draws = system.with_only(np.zeros(len(chosen), np.bool_)).draws(T)
    agree = pairs[system.cycles(T, draws, loops[pairs]) < wide]
    shape = (len(loops), len(loops))
    edges = scipy.sparse.coo_array((np.ones(len(agree)), (agree[:, 0], agree[:, 1])), shape=shape)
    return np.asarray(connected_components(edges, directed=False)[1], np.int64)


def _near(ends: IntArray) -> IntArray:
    """Return (P, 2) pairs of loops with (C, 2) ends that follow each other by either end."""
    found = []
    for first in (0, 1):
        order = np.lexsort((ends[:, 1 - first], ends[:, first]))
        for step in range(1, _NEIGHBOURS + 1):
            found.append(np.stack([order[:-step], order[step:]], axis=1))
    return np.unique(np.sort(np.concatenate(found), axis=1), axis=0)

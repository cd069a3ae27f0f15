# SPDX-License-Identifier: Apache-2.0
"""How well a graph knows where its keyframes are."""

import numpy as np

from slam.pose_graph.graph import PoseGraph
from slam.pose_graph.motion_system import MotionSystem
from slam.types import FloatArray


def uncertainty(graph: PoseGraph) -> FloatArray:
    """Return (K, 6, D) tangents: draws of how far off the poses may be that the graph begins with.

    They are those of its solution; all of its loops are believed. What two poses have in common is
    in the draws, too. The first one is held.
    """
    if len(graph.T_world_kf) < 2:  # which no motion connects
        return np.zeros((len(graph.T_world_kf), 6, 1))
    system = MotionSystem(graph)
    return system.draws(system.T_links)

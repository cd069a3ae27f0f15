# SPDX-License-Identifier: Apache-2.0
"""The pose graph: odometry is believed, all other motions have to agree with it and each other."""

from slam.pose_graph.g2o import read_g2o, write_g2o
from slam.pose_graph.graph import GraphSolution, PoseGraph

__all__ = ["GraphSolution", "PoseGraph", "read_g2o", "write_g2o"]

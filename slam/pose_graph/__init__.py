# SPDX-License-Identifier: Apache-2.0
"""The pose graph: links are believed, loops have to agree with them and with each other."""

from slam.pose_graph.g2o import read_g2o, write_g2o
from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.live import solve_beside
from slam.pose_graph.weighing import solve

__all__ = ["GraphSolution", "PoseGraph", "read_g2o", "solve", "solve_beside", "write_g2o"]

# SPDX-License-Identifier: Apache-2.0
"""The pose graph: links are believed, loops have to agree with them and with each other.

What needs GTSAM is loaded when it is first asked for: the camera is tracked without it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.leave_one_out import leave_one_out
from slam.pose_graph.live import solve_beside
from slam.pose_graph.uncertainty import uncertainty

if TYPE_CHECKING:
    from slam.pose_graph.from_g2o import solve_g2o
    from slam.pose_graph.g2o import read_g2o, write_g2o
    from slam.pose_graph.weighing import solve

__all__ = [
    "GraphSolution",
    "PoseGraph",
    "leave_one_out",
    "read_g2o",
    "solve",
    "solve_beside",
    "solve_g2o",
    "uncertainty",
    "write_g2o",
]

_HOME = {"read_g2o": "g2o", "solve": "weighing", "solve_g2o": "from_g2o", "write_g2o": "g2o"}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)

# SPDX-License-Identifier: Apache-2.0
"""A g2o file of anybody's as a pose graph whose loops have to prove themselves."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.geometry import se3
from slam.pose_graph.batch import pose_at
from slam.pose_graph.g2o import read_g2o
from slam.pose_graph.graph import GraphSolution, PoseGraph
from slam.pose_graph.weighing import solve
from slam.types import FloatArray, Link, RelativePose, SlamError


def solve_g2o(path: Path, inlier_probability: float = 0.95) -> GraphSolution:
    """Solve a 2-D or 3-D g2o file; loops have weights by which edge of the file, from 0, they are.

    Edges between keyframes whose numbers follow each other are the odometry, which is believed. All
    others are loops. Poses of the file are not read: the odometry begins at the origin.

    Raises:
        SlamError: the file cannot be read, or the odometry has a gap.
    """
    return solve(pose_graph_of(read_g2o(path)[0], str(path)), inlier_probability)


def pose_graph_of(factors: gtsam.NonlinearFactorGraph, source: str) -> PoseGraph:
    """Return the graph of the between factors, all of 2-D or all of 3-D, of what they came from.

    Raises:
        SlamError: the odometry has a gap.
    """
    edges: list[Any] = [factors.at(i) for i in range(factors.size())]
    links, loops = [], {}
    steps: dict[int, FloatArray] = {}
    for number, edge in enumerate(edges):
        ref, query = edge.keys()
        link = _link(edge)
        if abs(query - ref) != 1:
            loops[number] = link
            continue
        links.append(link)
        motion = link.motion.T_ref_query
        steps.setdefault(max(ref, query), motion if query > ref else se3.inverse(motion))
    keys = sorted({key for edge in edges for key in edge.keys()})  # noqa: SIM118, not a dict
    T_world_kf = {keys[0]: np.eye(4)}
    for before, key in pairwise(keys):
        if key not in steps:
            raise SlamError(
                f"no odometry leads to keyframe {key}, an edge from {key - 1} is needed: {source}"
            )
        T_world_kf[key] = T_world_kf[before] @ steps[key]
    return PoseGraph(T_world_kf, links, loops, is_planar=edges[0].dim() == 3)


def rigid(values: gtsam.Values, key: int) -> FloatArray:
    """Return the (4, 4) pose of a key in a 2-D or 3-D solution."""
    return _rigid(pose_at(values, key))


def _link(edge: Any) -> Link:
    ref, query = edge.keys()
    information = np.asarray(edge.noiseModel().information())
    if len(information) == 3:
        # Out of the plane nothing ever differs, so any number does; GTSAM has the angle last.
        inside = np.ix_([2, 3, 4], [2, 3, 4])
        planar, information = information, np.eye(6) * information[2, 2]
        information[inside] = planar[np.ix_([2, 0, 1], [2, 0, 1])]
    return Link(ref, query, RelativePose(_rigid(edge.measured()), information))


def _rigid(pose: Any) -> FloatArray:
    if isinstance(pose, gtsam.Pose3):
        return np.asarray(pose.matrix(), np.float64)
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = pose.rotation().matrix(), pose.translation()
    return T

# SPDX-License-Identifier: Apache-2.0
"""Pose graphs as g2o files: written in 3-D, read in 2-D and 3-D.

GTSAM's own reader stops without a word at the first comment of a 2-D file, and writes 6 digits.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from placerec.files import read_text, write_atomically
from slam.geometry import se3
from slam.pose_graph.batch import pose_at
from slam.types import FloatArray, Link, SlamError

# How many keyframe numbers and how many other numbers follow each tag: a pose, or a motion and the
# upper triangle of its information matrix.
_FIELDS = {
    "VERTEX_SE2": (1, 3),
    "EDGE_SE2": (2, 3 + 6),
    "VERTEX_SE3:QUAT": (1, 7),
    "EDGE_SE3:QUAT": (2, 7 + 21),
}
# g2o's tangents have the translation first, ours the rotation; in 2-D both begin with it.
_G2O_ORDER = [3, 4, 5, 0, 1, 2]


def write_g2o(path: Path, T_world_kf: FloatArray, motions: Iterable[Link]) -> None:
    """Write a 3-D pose graph in place of the file, in whole or not at all.

    Poses are (K, 4, 4), metres; the row is the keyframe's id, NaN where it is left out. The motions
    are the links, and the loops that hold.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    known = np.flatnonzero(np.isfinite(T_world_kf).all(axis=(1, 2)))
    lines = [f"VERTEX_SE3:QUAT {i} {_pose_text(T_world_kf[i])}" for i in known]
    for each in motions:
        information = each.motion.information[np.ix_(_G2O_ORDER, _G2O_ORDER)]
        text = f"{_pose_text(each.motion.T_ref_query)} {_numbers(information[np.triu_indices(6)])}"
        lines.append(f"EDGE_SE3:QUAT {each.ref_id} {each.query_id} {text}")
    write_atomically(path, "\n".join(lines) + "\n")


def read_g2o(path: Path) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Read the between factors of a 2-D or 3-D pose graph and a first guess of its poses.

    Poses that the file does not give are chained from its edges.

    Raises:
        SlamError: the file is missing, or a line of it is not what g2o allows.
    """
    lines = read_text(path, what="the g2o file", kind=SlamError).split("\n")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    dimensions = set()
    for number, line in enumerate(lines, 1):
        tag, *fields = line.split() or ["#"]
        if tag.startswith("#") or tag == "FIX":
            continue
        place = f"line {number} of {path}"
        ids, numbers = _checked(tag, fields, place)
        dimensions.add("SE2" in tag)
        if len(ids) == 2:
            graph.add(_between(ids, numbers, place))
        elif values.exists(ids[0]):
            raise SlamError(f"vertex {ids[0]} is there twice: {place}")
        else:
            values.insert(ids[0], _pose(numbers))
    if not graph.size() or len(dimensions) > 1:
        raise SlamError(f"a g2o file needs EDGE_SE2 or EDGE_SE3:QUAT, only one of the two: {path}")
    return graph, _chained(graph, values, path)


def _checked(tag: str, fields: list[str], place: str) -> tuple[list[int], FloatArray]:
    """Return the keyframe numbers and the other numbers of a line."""
    if tag not in _FIELDS:
        raise SlamError(f"{tag} is not a tag of a pose graph ({', '.join(_FIELDS)}): {place}")
    id_count, needed = _FIELDS[tag][0], sum(_FIELDS[tag])
    if len(fields) != needed:
        raise SlamError(f"{tag} has {len(fields)} numbers, {needed} are needed: {place}")
    for field in fields[:id_count]:
        if not (field.isascii() and field.isdecimal()):
            raise SlamError(f"{field} is not a keyframe number: {place}")
    try:
        numbers = np.array([float(field) for field in fields[id_count:]])
    except ValueError as error:
        raise SlamError(f"{tag} holds something that is not a number: {place}") from error
    if not np.isfinite(numbers).all():
        raise SlamError(f"{tag} holds a number that is not finite: {place}")
    return [int(field) for field in fields[:id_count]], numbers


def _pose(numbers: FloatArray) -> Any:
    """Return the Pose2 of x, y, angle or the Pose3 of x, y, z and a quaternion x y z w."""
    if len(numbers) == 3:
        return gtsam.Pose2(*numbers)
    rotation = se3.from_quaternion(numbers[3:])
    return gtsam.Pose3(se3.from_rotation_translation(rotation, numbers[:3]))


def _between(ids: list[int], numbers: FloatArray, place: str) -> Any:
    is_planar = len(numbers) == 3 + 6
    size, width = (3, 3) if is_planar else (6, 7)
    upper = np.zeros((size, size))
    upper[np.triu_indices(size)] = numbers[width:]
    information = upper + np.triu(upper, 1).T
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        raise SlamError(f"the information matrix is not positive definite: {place}")
    factor: Any = gtsam.BetweenFactorPose2
    if not is_planar:
        factor = gtsam.BetweenFactorPose3
        information = information[np.ix_(_G2O_ORDER, _G2O_ORDER)]
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return factor(*ids, _pose(numbers[:width]), noise)


def _chained(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, path: Path) -> gtsam.Values:
    """Return the poses, those that are missing filled in along the edges."""
    edges: list[Any] = [graph.at(i) for i in range(graph.size())]
    if not values.size():
        first = min(min(edge.keys()) for edge in edges)
        values.insert(first, type(edges[0].measured())())
    while edges:
        waiting = []
        for edge in edges:
            ref, query = edge.keys()
            if values.exists(ref) and not values.exists(query):
                values.insert(query, pose_at(values, ref).compose(edge.measured()))
            elif values.exists(query) and not values.exists(ref):
                values.insert(ref, pose_at(values, query).compose(edge.measured().inverse()))
            elif not values.exists(ref):
                waiting.append(edge)
        if len(waiting) == len(edges):
            first, second = waiting[0].keys()
            raise SlamError(f"no edge ties {first} and {second} to the other poses: {path}")
        edges = waiting
    return values


def _pose_text(T: FloatArray) -> str:
    return _numbers([*T[:3, 3], *se3.to_quaternion(T[:3, :3])])


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)

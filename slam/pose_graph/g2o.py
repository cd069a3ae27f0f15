# SPDX-License-Identifier: Apache-2.0
"""Pose graphs as g2o files: written in 3-D, read in 2-D and 3-D.

GTSAM's own reader stops without a word at the first comment of a 2-D file, and writes 6 digits.
"""

import logging
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from placerec.files import read_text, write_atomically
from slam.geometry import se3
from slam.pose_graph.batch import pose_at
from slam.types import FloatArray, Link, SlamError

_log = logging.getLogger(__name__)

# How many whole numbers and how many other numbers follow each tag: a pose, or a motion and the
# upper triangle of its information matrix. The first whole numbers are of keyframes; those of a
# switch, which lets a loop be ignored, or of the offsets of the sensors may follow.
_FIELDS = {
    "VERTEX_SE2": (1, 3),
    "EDGE_SE2": (2, 3 + 6),
    "EDGE_SE2_SWITCHABLE": (3, 3 + 6),
    "VERTEX_SE3:QUAT": (1, 7),
    "EDGE_SE3:QUAT": (2, 7 + 21),
    "EDGE_SE3_SWITCHABLE": (3, 7 + 21),
    "EDGE_SE3_OFFSET": (4, 7 + 21),
    "PARAMS_SE3OFFSET": (1, 7),
}
_USUAL = ("VERTEX_SE2", "EDGE_SE2", "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
_OF_G2O = re.compile(r"(DEPRECATED_)?(VERTEX|EDGE|PARAMS|CACHE)_[A-Z0-9_:]+|ROBOTLASER\d|DATA_\w+")
_SILENT = ("FIX", "PARAMS_SE2OFFSET")  # says what is held still; and nothing without its edges
_LARGEST_ID = 2**64 - 1  # of a key of GTSAM
_LARGEST = 1e50  # beyond, squares of squares overflow
_QUATERNION_LENGTHS = (0.5, 2.0)  # what rounding and float32 leave of 1 is far inside
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

    Poses that the file does not give are chained from its edges. What else g2o knows, such as
    landmarks and priors, is left out, which the log tells in a line.

    Raises:
        SlamError: the file is missing, or a line of it is not what g2o allows.
    """
    lines = read_text(path, what="the g2o file", kind=SlamError).split("\n")
    found = _Content()
    for number, line in enumerate(lines, 1):
        tag, *fields = line.partition("#")[0].split() or ["FIX"]
        if tag not in _SILENT:
            _take(found, tag, fields, f"line {number} of {path}")
    left_out = ", ".join(f"{count} {tag}" for tag, count in sorted(found.left_out.items()))
    if not found.edges or len(found.dimensions) > 1:
        instead = f"; there are {left_out}" if left_out else ""
        raise SlamError(
            f"a g2o file needs EDGE_SE2 or EDGE_SE3:QUAT, only one of the two{instead}: {path}"
        )
    if left_out:
        _log.warning("only motions between poses are read, left out are %s: %s", left_out, path)
    if found.switches:
        _log.warning("%d loops are read without their switches: %s", found.switches, path)
    graph = gtsam.NonlinearFactorGraph()
    for ids, numbers, place in found.edges:
        graph.add(_between(ids, numbers, found.offsets, place))
    return graph, _chained(graph, found.values, path)


@dataclass
class _Content:
    """What the lines of a file hold; an edge is its whole numbers, the others and its place."""

    edges: list[tuple[list[int], FloatArray, str]] = field(default_factory=list)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    offsets: dict[int, FloatArray] = field(default_factory=dict)
    dimensions: set[bool] = field(default_factory=set)
    left_out: Counter[str] = field(default_factory=Counter)
    switches: int = 0


def _take(found: _Content, tag: str, fields: list[str], place: str) -> None:
    """Add what a line holds."""
    if tag not in _FIELDS and _OF_G2O.fullmatch(tag):
        found.left_out[tag] += 1
        return
    ids, numbers = _checked(tag, fields, place)
    if tag == "PARAMS_SE3OFFSET":
        found.offsets[ids[0]] = _rigid(numbers)
        return
    found.dimensions.add("SE2" in tag)
    if tag.startswith("EDGE"):
        is_switchable = tag.endswith("_SWITCHABLE")
        found.switches += is_switchable
        found.edges.append((ids[:2] if is_switchable else ids, numbers, place))
    elif found.values.exists(ids[0]):
        raise SlamError(f"vertex {ids[0]} is there twice: {place}")
    else:
        found.values.insert(ids[0], _pose(numbers))


def _checked(tag: str, fields: list[str], place: str) -> tuple[list[int], FloatArray]:
    """Return the whole numbers and the other numbers of a line."""
    if tag not in _FIELDS:
        raise SlamError(f"{tag[:40]} is not a tag of a pose graph ({', '.join(_USUAL)}): {place}")
    id_count, needed = _FIELDS[tag][0], sum(_FIELDS[tag])
    if len(fields) != needed:
        raise SlamError(f"{tag} has {len(fields)} numbers, {needed} are needed: {place}")
    ids = [_keyframe_number(text, place) for text in fields[:id_count]]
    if tag.startswith("EDGE") and ids[0] == ids[1]:
        raise SlamError(f"an edge ties keyframe {ids[0]} to itself: {place}")
    try:
        if any("_" in text or not text.isascii() for text in fields):
            raise ValueError  # float takes 1_000 and the digits of other scripts
        numbers = np.array([float(text) for text in fields[id_count:]])
    except ValueError as error:
        raise SlamError(f"{tag} holds something that is not a number: {place}") from error
    if not np.isfinite(numbers).all():
        raise SlamError(f"{tag} holds a number that is not finite: {place}")
    if np.abs(numbers).max() > _LARGEST:
        raise SlamError(f"{tag} holds a number larger than {_LARGEST:g}: {place}")
    length = float(np.linalg.norm(numbers[3:7]))
    if "SE3" in tag and not _QUATERNION_LENGTHS[0] <= length <= _QUATERNION_LENGTHS[1]:
        raise SlamError(f"{tag} has a quaternion of length {length:g}, 1 is needed: {place}")
    return ids, numbers


def _keyframe_number(text: str, place: str) -> int:
    digits = text.lstrip("0") or "0"
    is_number = text.isascii() and text.isdecimal()
    if not is_number or len(digits) > len(str(_LARGEST_ID)) or int(digits) > _LARGEST_ID:
        raise SlamError(
            f"{text[:40]} is not a keyframe number, a whole one from 0 to 2^64 - 1: {place}"
        )
    return int(digits)


def _pose(numbers: FloatArray) -> Any:
    """Return the Pose2 of x, y, angle or the Pose3 of x, y, z and a quaternion x y z w."""
    if len(numbers) == 3:
        return gtsam.Pose2(*numbers)
    return gtsam.Pose3(_rigid(numbers))


def _rigid(numbers: FloatArray) -> FloatArray:
    """Return the (4, 4) transform of x, y, z and a quaternion x y z w."""
    return se3.from_rotation_translation(se3.from_quaternion(numbers[3:]), numbers[:3])


def _between(
    ids: list[int], numbers: FloatArray, offsets: dict[int, FloatArray], place: str
) -> Any:
    is_planar = len(numbers) == 3 + 6
    size, width = (3, 3) if is_planar else (6, 7)
    upper = np.zeros((size, size))
    upper[np.triu_indices(size)] = numbers[width:]
    information = upper + np.triu(upper, 1).T
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        raise SlamError(f"the information matrix is not positive definite: {place}")
    gaussian = gtsam.noiseModel.Gaussian.Information
    ref_id, query_id, *sensors = ids
    if is_planar:
        planar = gtsam.Pose2(*numbers[:width])
        return gtsam.BetweenFactorPose2(ref_id, query_id, planar, gaussian(information))
    information = information[np.ix_(_G2O_ORDER, _G2O_ORDER)]
    T_ref_query = _rigid(numbers[:width])
    if sensors:
        for each in sensors:
            if each not in offsets:
                raise SlamError(f"there is no PARAMS_SE3OFFSET {each}: {place}")
        T_ref_a, T_query_b = (offsets[each] for each in sensors)
        to_b = se3.adjoint(se3.inverse(T_query_b))
        T_ref_query = T_ref_a @ T_ref_query @ se3.inverse(T_query_b)
        information = to_b.T @ information @ to_b
    motion = gtsam.Pose3(T_ref_query)
    return gtsam.BetweenFactorPose3(ref_id, query_id, motion, gaussian(information))


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

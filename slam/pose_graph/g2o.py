# SPDX-License-Identifier: Apache-2.0
"""Pose graphs as g2o files: written in 3-D, read in 2-D and 3-D."""

import math
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

import gtsam
import numpy as np

from slam import se3
from slam.types import FloatArray, Link, SlamError

# How many numbers follow each tag. An edge carries two ids, a motion and the upper triangle of
# its information matrix.
_FIELDS = {
    "VERTEX_SE2": 1 + 3,
    "EDGE_SE2": 2 + 3 + 6,
    "VERTEX_SE3:QUAT": 1 + 7,
    "EDGE_SE3:QUAT": 2 + 7 + 21,
}
_IGNORED = {"FIX"}
_UPPER = np.triu_indices(6)
# g2o's tangents have the translation first, ours the rotation.
_G2O_ORDER = [3, 4, 5, 0, 1, 2]


def write_g2o(path: Path, T_world_kf: FloatArray, motions: Iterable[Link]) -> None:
    """Write a 3-D pose graph, in whole or not at all.

    Args:
        path: the file; an existing one is replaced.
        T_world_kf: (K, 4, 4), metres; the row is the keyframe's id.
        motions: links, and the loops that hold as links too.

    Raises:
        SlamError: the file cannot be written.
    """
    lines = [f"VERTEX_SE3:QUAT {i} {_pose_text(T)}" for i, T in enumerate(T_world_kf)]
    lines += [_edge_text(each) for each in motions]
    _replace(path, "\n".join(lines) + "\n")


def read_g2o(path: Path) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Read the between factors of a 2-D or 3-D pose graph and a first guess of its poses.

    Poses that the file does not give are chained from its edges.

    Raises:
        SlamError: the file is missing, or a line of it is not what g2o allows.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SlamError(f"cannot read the g2o file: {error}: {path}") from error
    tags = {_checked_tag(line, f"line {n} of {path}") for n, line in enumerate(text.split("\n"), 1)}
    is_3d = "EDGE_SE3:QUAT" in tags
    if is_3d == ("EDGE_SE2" in tags):
        raise SlamError(f"a g2o file needs EDGE_SE2 or EDGE_SE3:QUAT lines, one of the two: {path}")
    graph, values = gtsam.readG2o(str(path), is_3d)
    return graph, values


def _checked_tag(line: str, place: str) -> str:
    """Return the tag of a line that is in order, empty for a blank line or a comment."""
    tag, *fields = line.split() or ["#"]
    if tag.startswith("#") or tag in _IGNORED:
        return ""
    if tag not in _FIELDS:
        raise SlamError(f"{tag} is not a tag of a pose graph ({', '.join(_FIELDS)}): {place}")
    if len(fields) != _FIELDS[tag]:
        raise SlamError(f"{tag} has {len(fields)} numbers, {_FIELDS[tag]} are needed: {place}")
    for field in fields:
        if not _is_finite(field):
            raise SlamError(f"{field} is not a finite number: {place}")
    return tag


def _is_finite(field: str) -> bool:
    try:
        return math.isfinite(float(field))
    except ValueError:
        return False


def _pose_text(T: FloatArray) -> str:
    return _numbers([*T[:3, 3], *se3.to_quaternion(T[:3, :3])])


def _edge_text(link: Link) -> str:
    information = link.motion.information[np.ix_(_G2O_ORDER, _G2O_ORDER)]
    motion = _pose_text(link.motion.T_ref_query)
    return f"EDGE_SE3:QUAT {link.ref_id} {link.query_id} {motion} {_numbers(information[_UPPER])}"


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _replace(path: Path, text: str) -> None:
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise SlamError(f"cannot write the pose graph: {error.strerror}: {path}") from error

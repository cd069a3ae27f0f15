# SPDX-License-Identifier: Apache-2.0
"""Recordings in the format of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slam import se3
from slam.config import InputConfig
from slam.datasets.association import associate, smallest_gap_s
from slam.datasets.cameras import choose_camera
from slam.datasets.sequence import ImagePair, Sequence
from slam.types import FloatArray, SlamError, Trajectory

_SEPARATOR = re.compile(r"[\s,]+")
_MANY_UNPAIRED = 0.1
_MIN_QUATERNION_NORM = 1e-6


def open_sequence(path: Path, config: InputConfig) -> Sequence:
    """Open a folder that holds rgb.txt, depth.txt and, where the truth is known, groundtruth.txt.

    Raises:
        SlamError: the folder, a list, the camera, the association or most images are not usable.
    """
    try:
        _check_folder(path)
    except OSError as error:
        raise SlamError(f"cannot look into the folder: {error.strerror}: {path}") from error
    warnings: list[str] = []
    color_s, color_paths = _read_image_list(path / "rgb.txt", warnings)
    depth_s, depth_paths = _read_image_list(path / "depth.txt", warnings)
    pairs = associate(color_s, depth_s, config.max_time_difference_s)
    if not len(pairs):
        raise SlamError(
            "no colour and depth image are close enough in time: the smallest difference is"
            f" {smallest_gap_s(color_s, depth_s):.6g} s, allowed are"
            f" {config.max_time_difference_s:g} s (--input.max-time-difference-s): {path}"
        )
    unpaired = len(color_s) - len(pairs), len(depth_s) - len(pairs)
    if unpaired[0] > _MANY_UNPAIRED * len(color_s):
        warnings.append(
            f"{unpaired[0]} of {len(color_s)} colour images have no depth image within"
            f" {config.max_time_difference_s:g} s and are not used"
        )
    return Sequence(
        path.resolve().name,
        choose_camera(path, config),
        [ImagePair(float(color_s[i]), color_paths[i], depth_paths[k]) for i, k in pairs],
        ground_truth=_read_ground_truth(path / "groundtruth.txt", warnings),
        unpaired_color=unpaired[0],
        unpaired_depth=unpaired[1],
        warnings=tuple(warnings),
    )


def _check_folder(path: Path) -> None:
    if not path.exists():
        raise SlamError(
            "there is no such folder; give a folder in the TUM RGB-D format, or a short name of"
            f" that benchmark such as fr1_desk: {path}"
        )
    if not path.is_dir():
        raise SlamError(f"expected a folder in the TUM RGB-D format, found a file: {path}")
    missing = [name for name in ("rgb.txt", "depth.txt") if not (path / name).is_file()]
    if not missing:
        return
    inner = sorted(path.glob("*/rgb.txt"))
    found = sorted(entry.name for entry in path.iterdir())
    seen = ", ".join(found[:5]) + (", ..." if len(found) > 5 else "") if found else "nothing"
    hint = f"; did you mean its folder {inner[0].parent.name}?" if inner else ""
    raise SlamError(
        f"not a TUM RGB-D sequence: {' and '.join(missing)} not found, only {seen}{hint} (short"
        f" names of the benchmark such as fr1_desk work too): {path}"
    )


def _read_image_list(file: Path, warnings: list[str]) -> tuple[FloatArray, list[Path]]:
    stamps_s: list[float] = []
    paths: list[Path] = []
    for number, line in _lines(file):
        fields = _SEPARATOR.split(line, maxsplit=1)
        values = _finite(fields[:1])
        if values is None or len(fields) != 2:
            raise SlamError(f'line {number} is not "timestamp filename": {line!r}: {file}')
        stamps_s += values
        paths.append(file.parent / fields[1])
    if not paths:
        raise SlamError(f"the list names no image: {file}")
    kept = _in_order(np.array(stamps_s), file, warnings)
    return np.array(stamps_s)[kept], [paths[i] for i in kept]


def _read_ground_truth(file: Path, warnings: list[str]) -> Trajectory | None:
    if not file.is_file():
        return None
    rows: list[list[float]] = []
    for number, line in _lines(file):
        values = _finite(_SEPARATOR.split(line))
        if values is None or len(values) != 8:
            raise SlamError(
                f'line {number} is not "timestamp tx ty tz qx qy qz qw" in finite numbers:'
                f" {line!r}: {file}"
            )
        if np.linalg.norm(values[4:]) < _MIN_QUATERNION_NORM:
            raise SlamError(f"line {number} has a quaternion of length zero: {line!r}: {file}")
        rows.append(values)
    if not rows:
        warnings.append(f"{file.name} holds no pose, so there is no ground truth")
        return None
    table = np.array(rows)
    table = table[_in_order(table[:, 0], file, warnings)]
    T_world_cam = np.tile(np.eye(4), (len(table), 1, 1))
    T_world_cam[:, :3, :3] = se3.from_quaternion(table[:, 4:])
    T_world_cam[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0], T_world_cam)


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield (line number, text) of the lines that hold data."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise SlamError(f"cannot read the list: {error.strerror}: {file}") from error
    except UnicodeDecodeError as error:
        raise SlamError(f"the list is not text in UTF-8: {file}") from error
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def _finite(fields: list[str]) -> list[float] | None:
    try:
        values = [float(field) for field in fields]
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def _in_order(stamps_s: FloatArray, file: Path, warnings: list[str]) -> list[int]:
    """Return the lines to keep: in the order of time, of equal times the first."""
    order = np.argsort(stamps_s, kind="stable")
    is_new = np.concatenate([[True], np.diff(stamps_s[order]) > 0.0])
    if (np.diff(stamps_s) < 0.0).any():
        warnings.append(f"{file.name} is not in the order of time; it was sorted")
    if not is_new.all():
        warnings.append(
            f"{file.name} has {int((~is_new).sum())} line(s) whose timestamp came before; the"
            " first of each was used"
        )
    kept: list[int] = order[is_new].tolist()
    return kept

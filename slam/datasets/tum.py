# SPDX-License-Identifier: Apache-2.0
"""Recordings in the format of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt."""

import re
from pathlib import Path

import numpy as np

from slam.config import InputConfig
from slam.datasets.association import associate, smallest_gap_s
from slam.datasets.cameras import freiburg_camera, named_camera, rescaled
from slam.datasets.sequence import ImagePair, Sequence
from slam.datasets.tables import as_numbers, in_order, read_lines
from slam.datasets.true_poses import read_pose_list
from slam.types import FloatArray, SlamError

_SEPARATOR = re.compile(r"[\s,]+")
_MANY_UNPAIRED = 0.1


def open_tum(path: Path, config: InputConfig) -> Sequence:
    """Open a folder that holds rgb.txt, depth.txt and, where the truth is known, groundtruth.txt.

    Raises:
        SlamError: a list, the camera, the association or most images are not usable.
    """
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
    truth = path / "groundtruth.txt"
    return Sequence(
        path.resolve().name,
        rescaled(named_camera(path, config) or freiburg_camera(path), config),
        [ImagePair(float(color_s[i]), color_paths[i], depth_paths[k]) for i, k in pairs],
        ground_truth=read_pose_list(truth, warnings) if truth.is_file() else None,
        unpaired_color=unpaired[0],
        unpaired_depth=unpaired[1],
        warnings=tuple(warnings),
    )


def _read_image_list(file: Path, warnings: list[str]) -> tuple[FloatArray, list[Path]]:
    stamps_s: list[float] = []
    paths: list[Path] = []
    for number, line in read_lines(file):
        fields = _SEPARATOR.split(line, maxsplit=1)
        values = as_numbers(fields[:1])
        if values is None or len(fields) != 2:
            raise SlamError(f'line {number} is not "timestamp filename": {line!r}: {file}')
        stamps_s += values
        paths.append(file.parent / fields[1])
    if not paths:
        raise SlamError(f"the list names no image: {file}")
    kept = in_order(np.array(stamps_s), file, warnings)
    return np.array(stamps_s)[kept], [paths[i] for i in kept]

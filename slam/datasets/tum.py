# SPDX-License-Identifier: Apache-2.0
"""Recordings in the format of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.config import InputConfig
from slam.datasets.cameras import freiburg_camera, named_camera, rescaled
from slam.datasets.sequence import ImagePair, Sequence
from slam.datasets.true_poses import as_numbers, in_order, read_lines, read_pose_list
from slam.types import FloatArray, SlamError

_NEIGHBOURS = 8  # a stamp's partner is looked for among this many nearest ones


@dataclass(frozen=True)
class _Chain:
    """Pairs in the order of time, linked backwards from the last."""

    pair: tuple[int, int]
    before: "_Chain | None"
    count: int
    total_difference_s: float

    @staticmethod
    def grow(before: "_Chain | None", pair: tuple[int, int], difference_s: float) -> "_Chain":
        if before is None:
            return _Chain(pair, None, 1, difference_s)
        total_s = before.total_difference_s + difference_s
        return _Chain(pair, before, before.count + 1, total_s)


def associate(
    first_s: FloatArray, second_s: FloatArray, max_difference_s: float
) -> NDArray[np.intp]:
    """Return (M, 2) indices of paired timestamps: as many as possible, then as close as possible.

    Takes (N,) and (K,) increasing timestamps, seconds. Each is used once and the order of time is
    kept. Serving the closest pairs first would strand neighbours whenever the two streams are half
    a period out of step: on fr1_desk that loses 22 of 595 frames.
    """
    # best[k]: the best chain that uses only second[:k]; filled as far as pairs have been looked at.
    best: list[_Chain | None] = [None]
    for i, time_s in enumerate(first_s.tolist()):
        window = _near(second_s, time_s, max_difference_s)
        best += [best[-1]] * (window.stop + 1 - len(best))
        differences_s = np.abs(second_s[window.start : window.stop] - time_s).tolist()
        grown = [
            _Chain.grow(best[k], (i, k), difference_s)
            for k, difference_s in zip(window, differences_s, strict=True)
        ]
        for k, chain in zip(window, grown, strict=True):
            best[k + 1] = _better(best[k], _better(best[k + 1], chain))
        for k in range(window.stop + 1, len(best)):
            best[k] = _better(best[k], best[k - 1])
    return _unwind(best[-1])


def smallest_gap_s(first_s: FloatArray, second_s: FloatArray) -> float:
    """Return the smallest difference, seconds, between (N,) and (K,) increasing timestamps."""
    times_s = np.concatenate([first_s, second_s])
    order = np.argsort(times_s)
    is_first = order < len(first_s)
    return float(np.diff(times_s[order])[is_first[1:] != is_first[:-1]].min())


def _near(stamps_s: FloatArray, time_s: float, max_difference_s: float) -> range:
    start, stop = np.searchsorted(stamps_s, [time_s - max_difference_s, time_s + max_difference_s])
    stop += int(stop < len(stamps_s) and stamps_s[stop] - time_s <= max_difference_s)
    middle = int(np.searchsorted(stamps_s, time_s))
    return range(
        max(int(start), middle - _NEIGHBOURS // 2), min(int(stop), middle + _NEIGHBOURS // 2)
    )


def _better(a: _Chain | None, b: _Chain | None) -> _Chain | None:
    if a is None or b is None:
        return b if a is None else a
    return b if (b.count, -b.total_difference_s) > (a.count, -a.total_difference_s) else a


def _unwind(chain: _Chain | None) -> NDArray[np.intp]:
    pairs = []
    while chain is not None:
        pairs.append(chain.pair)
        chain = chain.before
    return np.array(pairs[::-1], dtype=np.intp).reshape(-1, 2)


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

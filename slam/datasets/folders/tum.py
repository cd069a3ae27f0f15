# SPDX-License-Identifier: Apache-2.0
"""Recordings in the format of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt.

Or with images already paired by its associate.py, or as ORB-SLAM asks for: associations.txt alone.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from placerec.datasets.times import Clock, in_order, in_seconds
from placerec.datasets.tum_lists import (
    as_number,
    is_whole,
    named_file,
    nearest,
    read_images,
    read_lines,
    split_fields,
    without_header,
)
from placerec.files import is_file
from slam.config import InputConfig
from slam.datasets.cameras import freiburg_camera, is_freiburg, named_camera, rescaled
from slam.datasets.images import is_depth
from slam.datasets.sequence import ImagePair, Sequence
from slam.datasets.true_poses import read_pose_list
from slam.types import FloatArray, IntArray, SlamError

_NEIGHBOURS = 8  # a stamp's partner is looked for among this many nearest ones
_MANY_UNPAIRED, _FEW_PAIRED = 0.1, 0.1


def open_tum(path: Path, config: InputConfig) -> Sequence:
    """Open a folder of rgb.txt, depth.txt and, where the truth is known, groundtruth.txt."""
    warnings: list[str] = []
    listed_s, color_paths = read_images(path / "rgb.txt", warnings)
    colors, color_s, clock = in_order(listed_s, path / "rgb.txt", warnings)
    depth_listed_s, depth_paths = read_images(path / "depth.txt", warnings)
    depths, depth_s, _ = in_order(depth_listed_s, path / "depth.txt", warnings, clock)
    images = [
        ImagePair(float(color_s[i]), color_paths[colors[i]], depth_paths[depths[k]])
        for i, k in pair_in_time(color_s, depth_s, config.max_time_difference_s, path, warnings)
    ]
    return _sequence(path, config, images, listed_s, clock, warnings)


def _sequence(
    path: Path,
    config: InputConfig,
    images: list[ImagePair],
    listed_s: FloatArray,
    clock: Clock,
    warnings: list[str],
) -> Sequence:
    file = path / "groundtruth.txt"
    truth = read_pose_list(file, warnings, listed_s, clock) if file.is_file() else None
    return Sequence(
        path.resolve().name,
        rescaled(named_camera(path, config) or freiburg_camera(path), config),
        images,
        ground_truth=truth,
        warnings=tuple(warnings),
        session_ends_s=clock.ends_s,
    )


def open_associations(path: Path, config: InputConfig) -> Sequence:
    """Open a folder of associations.txt and, where the truth is known, groundtruth.txt.

    A line is `time image time image`; which of the two is depth the images themselves tell, or the
    names of their folders.
    """
    warnings: list[str] = []
    file = path / "associations.txt"
    lines = without_header(read_lines(file))
    rows = [_read_association(number, line, file) for number, line in lines]
    if not rows:
        raise SlamError(f"the list names no image: {file}")
    if _depth_is_first(rows, file):
        rows = [(second, first) for first, second in rows]
    stamps = [stamp for (stamp, _), _ in rows]
    are_whole = all(is_whole(stamp) for stamp in stamps)
    if are_whole and not _knows_camera(path, config):
        raise SlamError(
            "the list counts images, and which camera made them is not known; ICL-NUIM's do, but"
            " then there is a *.gt.freiburg in the folder; for those of another put a camera.toml"
            f" there: {file}"
        )
    listed_s = in_seconds(
        np.array([*map(as_number, stamps)], np.float64), file, warnings, are_whole=are_whole
    )
    kept, times_s, clock = in_order(listed_s, file, warnings)
    images = [
        ImagePair(time_s, rows[i][0][1], rows[i][1][1])
        for i, time_s in zip(kept, times_s.tolist(), strict=True)
    ]
    return _sequence(path, config, images, listed_s, clock, warnings)


def _knows_camera(path: Path, config: InputConfig) -> bool:
    return is_freiburg(path) or named_camera(path, config) is not None


_Stamped = tuple[str, Path]


def _read_association(number: int, line: str, file: Path) -> tuple[_Stamped, _Stamped]:
    fields = split_fields(line)
    if len(fields) != 4 or None in map(as_number, fields[::2]):
        raise SlamError(f'line {number} is not "time image time image": {line!r}: {file}')
    first, second = (named_file(file.parent, name) for name in fields[1::2])
    return (fields[0], first), (fields[2], second)


def _depth_is_first(rows: list[tuple[_Stamped, _Stamped]], file: Path) -> bool:
    for (_, first), (_, second) in rows:
        kinds = [is_depth(first), is_depth(second)]
        if kinds[0] != kinds[1]:
            return kinds[0]
        if is_file(first) and is_file(second):
            break
    (_, first), (_, second) = rows[0]
    folder = file.parent.as_posix()
    named = ["depth" in path.as_posix().removeprefix(folder) for path in (first, second)]
    if named[0] != named[1]:
        return named[0]
    raise SlamError(
        f"which image of a line is depth is not known: neither {first.name} nor {second.name}"
        f" alone has one channel of 16 bits, or depth in its path: {file}"
    )


def pair_in_time(
    color_s: FloatArray,
    depth_s: FloatArray,
    max_difference_s: float,
    path: Path,
    warnings: list[str],
) -> IntArray:
    """Return (M, 2) indices of the colour and depth images, (N,) and (K,) times, that pair up.

    Raises:
        SlamError: none do, or next to none.
    """
    pairs = associate(color_s, depth_s, max_difference_s)
    fewer = min(len(color_s), len(depth_s))
    if len(pairs) and len(pairs) < _FEW_PAIRED * fewer:
        raise SlamError(
            f"of {len(color_s)} colour and {len(depth_s)} depth images only {len(pairs)} pair up"
            f" within {max_difference_s:g} s (--input.max-time-difference-s); are their times by"
            f" one clock, and in one unit? {path}"
        )
    if not len(pairs):
        smallest_s = np.abs(depth_s[nearest(depth_s, color_s)] - color_s).min()
        raise SlamError(
            "no colour and depth image are close enough in time: the smallest difference is"
            f" {smallest_s:.6g} s, allowed are"
            f" {max_difference_s:g} s (--input.max-time-difference-s): {path}"
        )
    unpaired = len(color_s) - len(pairs)
    if unpaired > _MANY_UNPAIRED * len(color_s):
        warnings.append(
            f"{unpaired} of {len(color_s)} colour images have no depth image within"
            f" {max_difference_s:g} s and are not used"
        )
    return pairs


def associate(first_s: FloatArray, second_s: FloatArray, max_difference_s: float) -> IntArray:
    """Return (M, 2) indices of paired timestamps: as many as possible, then as close as possible.

    Takes (N,) and (K,) increasing timestamps, seconds. Each is used once and the order of time is
    kept. Serving the closest pairs first would strand neighbours whenever the two streams are half
    a period out of step: on fr1_desk that loses 22 of 595 frames.
    """
    # best[k]: the best pairing that uses only second[:k]; filled as far as was looked.
    best = [_Pairing()]
    others_s = second_s.tolist()
    for i, time_s in enumerate(first_s.tolist()):
        window = _near(second_s, time_s, max_difference_s)
        best += [best[-1]] * (window.stop + 1 - len(best))
        grown = [best[k].and_pair(i, k, abs(others_s[k] - time_s)) for k in window]
        for k, pairing in zip(window, grown, strict=True):
            best[k + 1] = max(best[k], best[k + 1], pairing, key=_Pairing.worth)
        for k in range(window.stop + 1, len(best)):
            best[k] = max(best[k], best[k - 1], key=_Pairing.worth)
    pairs, pairing = [], best[-1]
    while pairing.before is not None:
        pairs.append(pairing.last)
        pairing = pairing.before
    return np.array(pairs[::-1], dtype=np.int64).reshape(-1, 2)


class _Pairing(NamedTuple):
    """Pairs in the order of time: the last one, and the pairing before it was added."""

    size: int = 0
    nearness_s: float = 0.0  # minus the sum of their differences
    last: tuple[int, int] = (-1, -1)
    before: "_Pairing | None" = None

    def and_pair(self, i: int, k: int, difference_s: float) -> "_Pairing":
        return _Pairing(self.size + 1, self.nearness_s - difference_s, (i, k), self)

    def worth(self) -> tuple[int, float]:
        return self.size, self.nearness_s


def _near(stamps_s: FloatArray, time_s: float, max_difference_s: float) -> range:
    start, stop = np.searchsorted(stamps_s, [time_s - max_difference_s, time_s + max_difference_s])
    stop += int(stop < len(stamps_s) and stamps_s[stop] - time_s <= max_difference_s)
    middle = int(np.searchsorted(stamps_s, time_s))
    return range(
        max(int(start), middle - _NEIGHBOURS // 2), min(int(stop), middle + _NEIGHBOURS // 2)
    )

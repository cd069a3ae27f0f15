# SPDX-License-Identifier: Apache-2.0
"""Files of an odometry's poses, one a line; their format is told by what they hold."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from placerec.datasets.times import in_order, like_images
from placerec.datasets.tum_lists import as_numbers, read_lines, split_fields
from placerec.files import write_atomically
from slam.config import InputConfig
from slam.datasets.bags import is_bag, read_bag_odometry
from slam.datasets.pose_formats import EUROC, FORMATS, PoseFormat, to_quaternion
from slam.evaluation.trajectory import placeable
from slam.types import FloatArray, SlamError, Trajectory

_NANOSECONDS = 1e14  # no time in seconds is as large, and one in nanoseconds no smaller since 1970
_NANOSECONDS_OF_TUM = 1e17  # in lines like TUM's, as some write them; microseconds are no larger
# Poses leap to and fro between two frames where every one is so many times as far from the next as
# from the one after, and further than this.
_TO_AND_FRO, _TO_AND_FRO_M = 5.0, 0.05


@dataclass(frozen=True)
class PoseFile:
    """The poses of a file, in the order of time.

    Attributes:
        format: how they are written there.
        trajectory: the poses as written: seconds, and the file's own unit and frame.
        stamps: (N,) the times as written; none where lines have no times.
        warnings: what a user should know; one sentence each.
        T_base_cam: where the camera is on the body that the poses are of, tx ty tz qx qy qz qw,
            None where the file does not tell.
    """

    format: PoseFormat
    trajectory: Trajectory
    stamps: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    T_base_cam: tuple[float, ...] | None = None


def read_odometry(path: Path, images_s: FloatArray, config: InputConfig) -> PoseFile:
    """Read poses from a file, or the odometry of a bag, for images at (N,) times.

    Raises:
        LoopcloseError: see `read_pose_file` and `read_bag_odometry`.
    """
    if not is_bag(path):
        return read_pose_file(path, images_s)
    bag = read_bag_odometry(path, config)
    _check_times(bag.trajectory.timestamps_s, images_s, path)
    stamps = tuple(f"{time_s:.9f}" for time_s in bag.trajectory.timestamps_s)
    T_base_cam = None if bag.T_body_cam is None else tuple(to_quaternion(bag.T_body_cam).tolist())
    return PoseFile(FORMATS[0], bag.trajectory, stamps, (), T_base_cam)


def read_pose_file(file: Path, images_s: FloatArray) -> PoseFile:
    """Read poses; where their lines have no times they belong to the images, (N,) seconds.

    Raises:
        LoopcloseError: the file cannot be read, holds no pose or something else, has no time in
            common with the images, or mixes poses of two frames.
    """
    form, lines, tables, T = _parsed(file)
    width = len(tables[0])
    if not form.has_time:
        trajectory = Trajectory(_images_of(len(T), images_s, file), T)
        _check_frame(trajectory, file)
        return PoseFile(form, trajectory, ())
    warnings: list[str] = []
    stamps_s = np.array([values[0] for values in tables])
    if form is EUROC:
        stamps_s /= 1e9
    else:
        stamps_s = like_images(stamps_s, images_s, file, warnings)
    kept, times_s, clock = in_order(stamps_s, file, warnings)
    if len(clock.ends_s):
        raise SlamError(
            f"the clock of the poses starts again {len(clock.ends_s)} time(s), so that which image"
            f" a pose belongs to is not known; write the times of one clock: {file}"
        )
    stamps = tuple(_stamp(lines[i][1], width) for i in kept)
    trajectory = Trajectory(times_s, T[kept])
    _check_times(trajectory.timestamps_s, images_s, file)
    _check_frame(trajectory, file)
    return PoseFile(form, trajectory, stamps, tuple(warnings))


def read_trajectory(file: Path) -> PoseFile:
    """Read poses to be compared as they stand: nothing is sorted, left out or moved in time.

    Where their lines have no times they get their numbers from 0; its format tells.

    Raises:
        LoopcloseError: the file cannot be read, holds no pose or something else, or a time is not
            after the one before; the message names the line.
    """
    form, lines, tables, T = _parsed(file)
    numbered = Trajectory(np.arange(len(T), dtype=np.float64), T)
    for i in np.flatnonzero(~placeable(numbered))[:1].tolist():
        number, line = lines[i]
        raise SlamError(f"line {number} holds no numbers that a place can have: {line!r}: {file}")
    if not form.has_time:
        return PoseFile(form, numbered, ())
    stamps_s = np.array([values[0] for values in tables])
    for i in np.flatnonzero(np.diff(stamps_s) <= 0.0)[:1].tolist():
        (before, _), (number, line) = lines[i], lines[i + 1]
        is_again = stamps_s[i] == stamps_s[i + 1]
        raise SlamError(
            f"line {number} has {'the time of' if is_again else 'a time before that of'} line"
            f" {before}; sort the lines by time, one per time: {line!r}: {file}"
        )
    if form is EUROC or stamps_s[0] > _NANOSECONDS_OF_TUM:
        stamps_s = stamps_s / 1e9
    return PoseFile(form, Trajectory(stamps_s, T), ())


def write_pose_file(file: Path, source: PoseFile, corrected: Trajectory) -> None:
    """Write poses as they are written in another file, at those of its times that they have.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    form, separator = source.format, source.format.separator
    stamp_of = dict(zip(source.trajectory.timestamps_s.tolist(), source.stamps, strict=False))
    lines = [f"#{separator.join(form.columns.split())}"] if form is EUROC else []
    for time_s, T in zip(corrected.timestamps_s.tolist(), corrected.T_world_cam, strict=True):
        # Adding 0.0 turns a rounded -0.0 into 0.0.
        numbers = [f"{value:.9f}" for value in np.round(form.numbers(T), 9) + 0.0]
        lines.append(separator.join([*([stamp_of[time_s]] if form.has_time else []), *numbers]))
    write_atomically(file, "\n".join(lines) + "\n")


def _parsed(
    file: Path,
) -> tuple[PoseFormat, list[tuple[int, str]], list[list[float]], FloatArray]:
    """Return the format, the N lines and their numbers, and their (N, 4, 4) poses."""
    lines = list(read_lines(file))
    if lines and _is_header(lines[0][1]):
        del lines[0]
    if not lines:
        raise SlamError(f"the file holds no pose ({_known()}): {file}")
    tables = [_numbers(number, line, file) for number, line in lines]
    form = _format(tables[0], lines[0], file)
    width = len(tables[0])
    T = np.empty((len(lines), 4, 4))
    for i, ((number, line), values) in enumerate(zip(lines, tables, strict=True)):
        if len(values) != width:
            raise SlamError(
                f"line {number} has {len(values)} numbers, the first one {width}: {line!r}: {file}"
            )
        try:
            T[i] = form.parse(np.array(values[form.has_time : form.count]))
        except SlamError as error:
            raise SlamError(f"line {number} {error}: {line!r}: {file}") from error
    return form, lines, tables, T


def _stamp(line: str, width: int) -> str:
    """Return the first number as it is written, but for a decimal comma."""
    fields = split_fields(line)
    if len(fields) == width:
        return fields[0]
    return re.split(r"[\s;]", line, maxsplit=1)[0].replace(",", ".")


def _is_header(line: str) -> bool:
    """Whether a table's first line names its columns."""
    is_a_name = line[0].isalpha() and not line.lower().startswith(("nan", "inf"))
    return as_numbers(line) is None and is_a_name


def _numbers(number: int, line: str, file: Path) -> list[float]:
    values = as_numbers(line)
    if values is None:
        raise SlamError(f"line {number} holds something else than finite numbers: {line!r}: {file}")
    return values


def _format(values: list[float], first: tuple[int, str], file: Path) -> PoseFormat:
    number, line = first
    if "," in line and values[0] > _NANOSECONDS and len(values) >= EUROC.count:
        return EUROC
    for form in FORMATS:
        if form.count == len(values):
            return form
    raise SlamError(
        f"line {number} has {len(values)} numbers, which is no known way to write a pose"
        f" ({_known()}): {line!r}: {file}"
    )


def _known() -> str:
    return "; ".join(f"{form.name}: {form.columns}" for form in (*FORMATS, EUROC))


def _images_of(count: int, images_s: FloatArray, file: Path) -> FloatArray:
    if count != len(images_s):
        raise SlamError(
            f"the lines have no times, so that there has to be one per image, but there are {count}"
            f" for {len(images_s)} images; put the time before each: {file}"
        )
    return images_s


def _check_times(stamps_s: FloatArray, images_s: FloatArray, file: Path) -> None:
    if stamps_s[0] > images_s[-1] or stamps_s[-1] < images_s[0]:
        raise SlamError(
            f"the poses are of {stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s, the images of"
            f" {images_s[0]:.3f} to {images_s[-1]:.3f} s, and have no time in common; do both use"
            f" one clock, and is it the odometry of this recording? {file}"
        )


def _check_frame(trajectory: Trajectory, file: Path) -> None:
    centres = trajectory.T_world_cam[:, :3, 3]
    if len(centres) < 5:
        return
    next_m = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    after_m = np.linalg.norm(centres[2:] - centres[:-2], axis=1)
    if np.median(next_m) > max(_TO_AND_FRO * float(np.median(after_m)), _TO_AND_FRO_M):
        raise SlamError(
            f"the poses leap to and fro, by {np.median(next_m):.2f} m from one to the next: those"
            f" of two frames or two bodies are mixed; keep those of one: {file}"
        )
